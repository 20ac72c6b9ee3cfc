"""`octn bench speed`: time to quality, rates, memory and queries, as ratios in one run on one machine."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column, filled_columns
from octn_ros.evaluation.speed_config import PLAIN, QUICK, SpeedBenchConfig
from octn_ros.evaluation.speed_curves import Curve, Yardstick, curve, time_to_quality, yardstick
from octn_ros.evaluation.speed_picture import curves_picture, samples_picture
from octn_ros.evaluation.speed_queries import AXIS_BY_AXIS, MANY, band_rows, lattice_rows, raster_rows, rate_rows
from octn_ros.evaluation.speed_samples import between_rows, sample_rows
from octn_ros.evaluation.speed_sizes import SizeCost, measure_size, to_target
from octn_ros.evaluation.speed_trainers import start_model
from octn_ros.field import NeuralField
from octn_ros.settings import as_plain
from octn_ros.training import fit
from octn_ros.training.warm_up import warm_up

COLUMNS = (
    Column("part", "what"),
    Column("phantom", "phantom"),
    Column("way", "way"),
    Column("field", "field"),
    Column("start", "start"),
    Column("seconds", "s", "{:.3g}"),
    Column("budget_s", "budget s", "{:g}"),
    Column("compile_s", "compile s", "{:.1f}"),
    Column("samples", "samples", "{:.3g}"),
    Column("psnr_truth_db", "truth dB", "{:.2f}"),
    Column("gaussian_truth_db", "Gaussian's", "{:.2f}"),
    Column("psnr_noisy_db", "voxels dB", "{:.2f}"),
    Column("psnr_fraction_db", "half a B-scan off dB", "{:.2f}"),
    Column("psnr_held_out_db", "held-out B-scans dB", "{:.2f}"),
    Column("msamples_s", "M samples/s", "{:.3g}"),
    Column("mpoints_s", "M points/s", "{:.3g}"),
    Column("fused_over_this", "fused / this", "{:.3g}"),
    Column("lattice_s", "lattice s", "{:.3g}"),
    Column("table_gb", "field GB", "{:.3g}"),
    Column("peak_gb", "peak GB", "{:.2f}"),
    Column("band_ratio_lattice", "exhaustive / index", "{:.3g}"),
    Column("band_ratio_numpy", "NumPy / index", "{:.3g}"),
    Column("index_s", "index s", "{:.3g}"),
    Column("index_gb", "index GB", "{:.3g}"),
    Column("raster_ratio_knn", "kNN / this", "{:.3g}"),
)
_PAPER = (
    {
        "part": "30 dB",
        "phantom": "TissueOCT 256x512x512",
        "way": "fused",
        "seconds": 10.0,
        "psnr_noisy_db": 30.0,
        "source": "abstract and section 4: 30 dB in under 10 s on an RTX 4080 Super, by tiny-cuda-nn",
    },
)
_DEVIATIONS = (
    "Phantoms with a known truth take the place of the paper's TissueOCT volumes; their speckle is averaged, 31 dB "
    "from the truth, as the paper's figures imply.",
    "The paper's seconds are of an NVIDIA RTX 4080 Super; these are of the machine named above.",
    "The fit is the preset fast, not the paper's 24 levels and 3 x 128 neurons.",
)
_NOTES = (
    "Ways: eager is plain torch, the reference (lone samples, dense Adam); compile the same with everything from the "
    "voxel look-up to the loss in one torch.compile'd graph (fullgraph, dynamic=False; Adam is torch's fused kernel in "
    "both); fused the kernels of this package. Compiling is left out of every time and stated.",
    "quality: seconds from the array until the field is as near to the truth as a Gaussian of one voxel, seen on 16 "
    "evenly spaced B-scans. Start data is the preset fast, whose first state is made from the volume by the same code "
    "for every way; start mean is the plain preset: random features, the volume's mean, the field that plain torch "
    "reaches it soonest with (4 bits per voxel, 4 features), learning rate 1e-2, and the smallest of the budgets that "
    "succeeds.",
    "quality_ratio_eager and quality_ratio_compile: seconds of eager and compile with the plain preset over those of "
    "fused with its preset, start from the data included. quality_ratio_*_same_preset: all with the preset fast, where "
    "the start does the work whoever takes the steps. quality_ratio_*_from_mean: all with the plain preset, which "
    "shows what kernels and bricks are worth without the start.",
    "rate: training samples per second, same field, batch, learning rate and start; train_ratio_* are those of "
    "the preset fast on the full phantom, train_ratio_*_many_levels those of 8 levels and two hidden layers of 32 "
    "there.",
    "lattice: eager answers point by point, as the paper's field is asked; axis by axis neighbours share their "
    "vertices, which this package's plain torch does by itself.",
    "30 dB: in a process of its own, from the array to a field that has answered, PSNR over all voxels; peak GB is the "
    "greatest resident memory of that process, Python and torch included.",
    "samples: PSNR at equal samples, bricks of 8 x 8 x 8 neighbours against lone voxels. between: what the start costs "
    "off the grid: truth half a B-scan between B-scans, and held-out B-scans of a fit to every second one; for a "
    "Gaussian the two neighbours are averaged.",
)


def run(request: BenchmarkRequest, config: SpeedBenchConfig | None = None) -> BenchmarkResult:
    """Measure everything on the device that the request names.

    Args:
        request: device, quick or full, progress.
        config: everything else; from the request if left out.

    Raises:
        OctnError: a folder of scans is given: they have no known truth.
    """
    if request.data is not None:
        raise ConfigurationError(
            f"speed: expected phantoms alone, got the scans in {request.data}, which have no known truth; leave --data "
            "out, and use octn fit on a scan"
        )
    config = config or (QUICK if request.quick else SpeedBenchConfig())
    began, device = time.perf_counter(), request.device
    tell = request.progress
    warm_up(config.fit_config("data"), device)

    tell("phantoms", 0.0, "")
    small, full = yardstick(config.shape, config.seed), yardstick(config.full_shape, config.seed)
    places = {_name(config.shape): small, _name(config.full_shape): full}
    tell("time to quality", 0.05, _name(config.shape))
    quality = quality_curves(config, small, device)
    tell("30 dB and cost against size", 0.4, "")
    sizes = size_costs(config, full, device)
    tell("curves", 0.5, _name(config.full_shape))
    long = full_curves(config, full, device)
    tell("rates", 0.65, "")
    rated = {name: each.phantom.volume for name, each in places.items() if config.thorough or each is full}
    rates = rate_rows(config, rated, device)
    tell("lattice and bands", 0.8, "")
    field = fit(full.phantom.volume, to_target(config.fit_config("data"), config.target_db), device=device).field
    queries = _query_rows(config, field, full)
    del field
    tell("raster", 0.88, "")
    queries += raster_rows(config, device)
    tell("samples", 0.92, "")
    some = yardstick(config.samples_shape, config.seed)
    samples = sample_rows(config, some, device)
    tell("between the B-scans", 0.97, "")
    between = between_rows(config, some, device)

    for row in samples + between:
        row["phantom"] = _name(config.samples_shape)
    rows = [
        *_curve_rows("quality", _name(config.shape), quality, small),
        *_size_rows(sizes),
        *_curve_rows("curve", _name(config.full_shape), long, full),
        *rates,
        *queries,
        *samples,
        *between,
    ]
    figures = headline(config, quality, list(sizes.values())[-1], rows)
    panels = {
        f"{_name(config.shape)}, until it is reached": (quality, small.on_curve_db),
        f"{_name(config.full_shape)}": (long, full.on_curve_db),
    }
    return BenchmarkResult(
        name="speed",
        title="time to quality, rates, memory and queries",
        rows=rows,
        columns=filled_columns(rows, COLUMNS),
        paper=_PAPER,
        deviations=_DEVIATIONS,
        notes=(*_NOTES, *_found(config, quality, figures)),
        configuration={
            "bench": as_plain(config),
            "plain": as_plain(PLAIN),
            "fast": as_plain(config.fit_config("data")),
        },
        seeds={"speckle": config.seed, "fit": config.seed},
        seconds=time.perf_counter() - began,
        pictures={
            "speed-psnr.png": curves_picture(panels, config.target_db),
            "speed-samples.png": samples_picture(samples),
        },
        figures=figures,
    )


def quality_curves(config: SpeedBenchConfig, against: Yardstick, device: str) -> list[Curve]:
    """Return the curves to the Gaussian's quality, of every way from the data and from the mean."""
    curves = []
    for start in ("data", "mean"):
        settings = config.fit_config(start)
        # Whoever is first must not pay for libraries that load at their first use.
        start_model(against.phantom.volume, settings, device)
        for way in reversed(config.ways):
            curves.append(time_to_quality(way, start, settings, against, device, config.budgets_s))
    return curves


def full_curves(config: SpeedBenchConfig, against: Yardstick, device: str) -> list[Curve]:
    """Return the curves on the full phantom: the preset fast by the kernels, the plain preset by every way."""
    ways = [("fused", "data"), *((way, "mean") for way in reversed(config.full_ways))]
    return [
        curve(way, start, config.fit_config(start), against, device, config.full_budget_s, stop_when_reached=False)
        for way, start in ways
    ]


def size_costs(config: SpeedBenchConfig, full: Yardstick, device: str) -> dict[Yardstick, SizeCost]:
    """Return what a fit to the target costs at 1/64, 1/8 and 1 of the full phantom, the last one last."""
    settings, threads = to_target(config.fit_config("data"), config.target_db), torch.get_num_threads()
    costs = {}
    for shape in config.sizes:
        against = full if shape == config.full_shape else yardstick(shape, config.seed)
        costs[against] = measure_size(against, settings, device, threads)
    return costs


def headline(
    config: SpeedBenchConfig, quality: Sequence[Curve], full: SizeCost, rows: Sequence[Mapping[str, Any]]
) -> dict[str, float | bool]:
    """Return the figures that stand for the whole: plain keys, numbers; a ratio may be a lower bound, which is told."""
    by = {(each.way, each.start): each for each in quality}
    fused = by["fused", "data"]
    figures: dict[str, float | bool] = {"seconds_to_gaussian_truth": fused.reached_s}
    for way in config.ways[:-1]:
        for name, here, there in (
            (f"quality_ratio_{way}", by[way, "mean"], fused),
            (f"quality_ratio_{way}_same_preset", by[way, "data"], fused),
            (f"quality_ratio_{way}_from_mean", by[way, "mean"], by["fused", "mean"]),
        ):
            reached = not math.isnan(here.reached_s)
            figures[name] = (here.reached_s if reached else here.budget_s) / there.reached_s
            figures[f"{name}_is_lower_bound"] = not reached
    place = _name(config.full_shape)
    for row in rows:
        if row["part"] == "rate" and row["phantom"] == place:
            key = f"train_ratio_{row['way']}" if row["way"] != "fused" else "train_msamples_s"
            value = row["msamples_s"] if row["way"] == "fused" else row["fused_over_this"]
            figures[f"{key}_many_levels" if row["field"] == MANY else key] = value
        if row["part"] == "lattice" and row["way"] == "fused":
            figures["lattice_mpoints_s"] = row["mpoints_s"]
        if row["part"] == "lattice" and row["way"] == "eager":
            figures["lattice_ratio_eager"] = row["fused_over_this"]
        if row["part"] == "lattice" and row["way"] == AXIS_BY_AXIS:
            figures["lattice_ratio_eager_axis_by_axis"] = row["fused_over_this"]
        if row["part"] == "raster" and row["way"] == "newton":
            figures["raster_ratio_knn"] = row["raster_ratio_knn"]
    figures["seconds_to_30db"] = full.fit_s if full.noisy_db >= config.target_db else math.nan
    figures["psnr_noisy_db"], figures["psnr_truth_db"] = full.noisy_db, full.truth_db
    bands = [row for row in rows if row["part"] == "band"]
    figures["band_ratio_lattice"] = min(row["band_ratio_lattice"] for row in bands)
    figures["band_ratio_numpy"] = min(row["band_ratio_numpy"] for row in bands)
    figures["peak_gb"] = full.peak_gb
    return figures


def _found(config: SpeedBenchConfig, quality: Sequence[Curve], figures: Mapping[str, float | bool]) -> list[str]:
    found = [
        f"The full phantom has {_name(config.full_shape)} voxels, the one of time to quality {_name(config.shape)}."
    ]
    missed = [f"{each.way} from the {each.start}" for each in quality if math.isnan(each.reached_s)]
    if missed:
        found.append(
            f"Not reached within {config.budgets_s[-1]:g} s: {', '.join(missed)}; ratios of theirs are lower "
            "bounds, or missing where it is the fused one that did not reach it."
        )
    if math.isnan(float(figures["seconds_to_30db"])):
        found.append(f"{config.target_db:g} dB was not reached on the full phantom.")
    return found


def _query_rows(config: SpeedBenchConfig, field: NeuralField, full: Yardstick) -> list[dict[str, Any]]:
    place = _name(config.full_shape)
    return lattice_rows(config, field, place) + band_rows(config, field, full, place)


def _curve_rows(part: str, place: str, curves: Sequence[Curve], against: Yardstick) -> list[dict[str, Any]]:
    return [
        {
            "part": part,
            "phantom": place,
            "way": each.way,
            "start": each.start,
            "seconds": each.reached_s,
            "budget_s": each.budget_s,
            "compile_s": each.compile_s,
            "samples": each.points[-1].samples,
            "psnr_truth_db": each.points[-1].truth_db,
            "psnr_noisy_db": each.points[-1].noisy_db,
            "gaussian_truth_db": against.on_curve_db,
            "points": [[p.seconds, p.samples, p.truth_db, p.noisy_db] for p in each.points],
        }
        for each in curves
    ]


def _size_rows(costs: Mapping[Yardstick, SizeCost]) -> list[dict[str, Any]]:
    return [
        {
            "part": "30 dB",
            "phantom": _name(against.phantom.volume.geometry.shape),
            "way": "fused",
            "start": "data",
            "seconds": cost.fit_s,
            "steps": cost.steps,
            "psnr_truth_db": cost.truth_db,
            "psnr_noisy_db": cost.noisy_db,
            "gaussian_truth_db": against.gaussian_db,
            "lattice_s": cost.lattice_s,
            "table_gb": cost.table_gb,
            "mpoints_s": against.phantom.volume.array.size / cost.lattice_s / 1e6,
            "peak_gb": cost.peak_gb,
            "backend": cost.backend,
        }
        for against, cost in costs.items()
    ]


def _name(shape: tuple[int, int, int]) -> str:
    return "x".join(str(n) for n in shape)
