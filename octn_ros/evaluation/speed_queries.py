"""Rates and ratios on the full phantom: training steps, whole lattices, intensity bands, a raster's first plan."""

from __future__ import annotations

import dataclasses
import statistics
import time
from typing import Any

import torch

from octn_ros.evaluation.band_timing import time_bands
from octn_ros.evaluation.raster import centred_raster
from octn_ros.evaluation.raster_config import SYSTEM, RasterBenchConfig
from octn_ros.evaluation.raster_fields import filtered, neural_field, phantom_config
from octn_ros.evaluation.speed_config import MANY_LEVELS, SpeedBenchConfig
from octn_ros.evaluation.speed_curves import Yardstick
from octn_ros.evaluation.speed_sizes import time_lattice
from octn_ros.evaluation.speed_trainers import (
    compile_steps,
    make_stepper,
    samples_per_s,
    start_model,
)
from octn_ros.field import NeuralField, NeuralFieldConfig
from octn_ros.planning import SurfaceSearchConfig, find_surface
from octn_ros.planning.baseline import knn_baseline
from octn_ros.simulation import make_phantom
from octn_ros.volume import Volume

# Outlier checks, which the baseline and the paper have none of.
_CHECK = "check"
# Plain torch is asked for fewer B-scans of the lattice, being slower.
_EAGER_BSCANS = 8
AXIS_BY_AXIS = "eager, axis by axis"
MANY = "many levels"


def rate_rows(config: SpeedBenchConfig, volumes: dict[str, Volume], device: str) -> list[dict[str, Any]]:
    """Return samples per second of every way of taking steps, at equal configuration.

    Two fields on each volume: that of the preset `fast`, and one of many levels; batch and learning rate are the
    preset's, and every way starts from the mean, which changes no step's cost. torch.compile is given each of its
    modes and the fastest counts.
    """
    rows: list[dict[str, Any]] = []
    for place, volume in volumes.items():
        fields = {"fast": config.fit_config("data").field} | ({MANY: MANY_LEVELS} if config.thorough else {})
        for name, shape in fields.items():
            rates: dict[str, float] = {}
            for way in config.ways:
                modes = config.compile_modes if way == "compile" and name == "fast" else ("default",)
                found = [_rate(config, way, shape, volume, device, mode) for mode in modes]
                best = max(found, key=lambda each: each[0])
                rates[way] = best[0]
                rows.append(
                    {
                        "part": "rate",
                        "phantom": place,
                        "way": way,
                        "field": name,
                        "msamples_s": best[0] / 1e6,
                        "compile_s": best[1],
                        "mode": best[2] if way == "compile" else None,
                        "fused_over_this": None,
                    }
                )
            for row in rows[-len(config.ways) :]:
                row["fused_over_this"] = rates["fused"] / rates[str(row["way"])]
    return rows


def lattice_rows(config: SpeedBenchConfig, field: NeuralField, place: str) -> list[dict[str, Any]]:
    """Return points per second of a whole lattice: by the field's own back end, by plain torch point by point as the
    paper's field is asked, and by plain torch axis by axis, which neighbouring points' common vertices allow."""
    eager = NeuralField(field.model, field.config, field.description, "torch")
    _, axials, laterals = field.geometry.shape
    rows: list[dict[str, Any]] = []
    for way, asked, bscans in (("fused", field, 0), ("eager", eager, _EAGER_BSCANS)):
        planes = min(bscans or field.geometry.shape[0], field.geometry.shape[0])
        time_lattice(asked, min(planes, 2))
        seconds = statistics.median(time_lattice(asked, planes) for _ in range(config.repeats))
        rate = planes * axials * laterals / seconds / 1e6
        rows.append({"part": "lattice", "phantom": place, "way": way, "backend": asked.backend, "mpoints_s": rate})
    rows[-1]["way"] = AXIS_BY_AXIS
    seconds = statistics.median(_time_points(eager) for _ in range(config.repeats))
    rate = axials * laterals / seconds / 1e6
    rows.append({"part": "lattice", "phantom": place, "way": "eager", "backend": "torch", "mpoints_s": rate})
    for row in rows:
        row["fused_over_this"] = rows[0]["mpoints_s"] / row["mpoints_s"]
    return rows


def band_rows(config: SpeedBenchConfig, field: NeuralField, against: Yardstick, place: str) -> list[dict[str, Any]]:
    """Return the bands of the paper's table 2 with the index, exhaustively and by NumPy on the raw voxels."""
    fresh = NeuralField(field.model, field.config, field.description)  # whose index is empty
    timings = time_bands(fresh, against.phantom.volume, config.region_side_m, config.repeats)
    return [
        {
            "part": "band",
            "phantom": place,
            "way": f"{band.low:g} to {band.high:g}",
            "seconds": band.indexed_s,
            "share": band.share,
            "band_ratio_lattice": band.ratio_lattice,
            "band_ratio_numpy": band.ratio_numpy,
            "index_s": timings.fill_s,
            "index_gb": timings.index_bytes / 1e9,
        }
        for band in timings.bands
    ]


def raster_rows(config: SpeedBenchConfig, device: str) -> list[dict[str, Any]]:
    """Return the first plan of a raster by Newton on a neural field and by the kNN baseline, on the same raw voxels.

    Core operations as `octn bench raster` counts them; every plan is made on a field that was not asked before.
    """
    settings = RasterBenchConfig(
        timing_shape=config.full_shape, timing_side_m=config.raster_side_m, fit_s=config.raster_fit_s, seed=config.seed
    )
    name = f"wavy{SYSTEM}"
    voxels = filtered(make_phantom(phantom_config(name, settings, settings.timing_shape)).volume, "raw")
    pattern = centred_raster(voxels.volume.geometry, settings.timing_side_m, settings.spacing_m)
    fitted = neural_field(voxels, device, settings).field
    assert isinstance(fitted, NeuralField)
    times: dict[str, list[float]] = {"baseline": [], "newton": []}
    for _ in range(1 + config.repeats):
        baseline = knn_baseline(voxels.volume, pattern)
        times["baseline"].append(sum(baseline.seconds.values()))
        fresh = NeuralField(fitted.model, fitted.config, fitted.description)
        search = find_surface(fresh, pattern, None, SurfaceSearchConfig(refinement="newton"))
        times["newton"].append(sum(s for stage, s in search.seconds.items() if stage != _CHECK))
    medians = {way: statistics.median(seconds[1:]) for way, seconds in times.items()}
    return [
        {
            "part": "raster",
            "phantom": name,
            "way": way,
            "samples": len(pattern.points_m),
            "seconds": seconds,
            "raster_ratio_knn": medians["baseline"] / seconds,
        }
        for way, seconds in medians.items()
    ]


def _time_points(field: NeuralField) -> float:
    """Return the seconds in which a field answers for the voxels of its middle B-scan, point by point."""
    _, axials, laterals = field.geometry.shape
    axial, lateral = torch.meshgrid(torch.linspace(-1, 1, axials), torch.linspace(-1, 1, laterals), indexing="ij")
    points = torch.stack((lateral, axial, torch.zeros_like(axial)), dim=-1).view(-1, 3).to(field.device)
    began = time.perf_counter()
    float(field.evaluate(points).sum())  # read, so that a device has done it
    return time.perf_counter() - began


def _rate(
    config: SpeedBenchConfig, way: str, shape: NeuralFieldConfig, volume: Volume, device: str, mode: str
) -> tuple[float, float, str]:
    # One share of interpolated samples throughout, so that torch compiles one graph.
    settings = dataclasses.replace(config.fit_config("mean"), field=shape, hybrid_share=1.0)
    stepper = make_stepper(way, start_model(volume, settings, device), volume, settings, mode)
    compile_s = compile_steps(stepper, settings)
    rate = samples_per_s(stepper, settings, config.rate_s)
    if device.startswith("cuda"):
        torch.cuda.empty_cache()
    return rate, compile_s, mode
