"""`octn bench curve`: the paper's figure 7, how a fit goes, and its final quality over scans and noise reduction."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column, Row, filled_columns
from octn_ros.evaluation.curve_config import QUICK, CurveBenchConfig
from octn_ros.evaluation.curve_picture import distribution_boxes, noise_reduction_boxes, training_curves
from octn_ros.evaluation.engine import run_volumes
from octn_ros.evaluation.grid_comparison import render_bscans
from octn_ros.evaluation.kept_rows import ScanResult
from octn_ros.evaluation.noise_reduction import reduce_noise
from octn_ros.evaluation.scans import BenchScan, scan_sources, stated_spacings
from octn_ros.field import Field
from octn_ros.metrics import SSIM_WINDOW, ssim
from octn_ros.settings import as_plain
from octn_ros.training import PRESETS, FitConfig, FitResult, fit
from octn_ros.training.held_in import evaluated_bscans, psnr_of_field
from octn_ros.volume import Volume

FROM_DATA, RANDOM = "from averages of the scan", "from random features"
ACCEPTABLE_DB = 30.0  # the paper's "acceptable PSNR"
COLUMNS = (
    Column("volume", "scan"),
    Column("group", "group"),
    Column("start", "start"),
    Column("noise_reduction", "noise reduction"),
    Column("acceptable_s", "30 dB after s", "{:.2f}"),
    Column("switch_s", "stages change at s", "{:.1f}"),
    Column("loss_first", "first loss", "{:.2e}"),
    Column("loss_switch", "loss before the change", "{:.2e}"),
    Column("loss_last", "last loss", "{:.2e}"),
    Column("curve_first_db", "first PSNR dB", "{:.2f}"),
    Column("curve_switch_db", "PSNR before the change dB", "{:.2f}"),
    Column("psnr_db", "final PSNR dB", "{:.2f}"),
    Column("ssim", "final SSIM", "{:.3f}"),
    Column("noise_free_psnr_db", "final, noise-free dB", "{:.2f}"),
    Column("steps", "steps", "{:.0f}"),
    Column("seconds", "fit s", "{:.1f}"),
)
# Fig. 7 is drawn, not tabulated: what its text and the abstract state.
PAPER: tuple[Row, ...] = (
    {"volume": "10 random volumes", "acceptable_s": 10.0, "psnr_db": 30.0, "source": "fig. 7a: > 30 dB in < 10 s"},
    {"group": "TissueOCT", "noise_reduction": "gain of 6.5 dB and 0.12 SSIM", "source": "fig. 7c, section III-D"},
    {"group": "Srinivasan", "noise_reduction": "gain of 3.3 dB and 0.002 SSIM", "source": "fig. 7c, section III-D"},
)
_DEVIATIONS = (
    "The curve's PSNR is on 16,384 fixed voxels of 16 evenly spaced B-scans, final PSNR and SSIM on all of their "
    "voxels; the paper takes whole B-scans throughout.",
    "The preset of the configuration within its time budget, on the CPU unless a device is named, not 24 levels on an "
    "NVIDIA 4080 Super. It begins with block averages of the scan; the rows that begin with random features, as "
    "Algorithm 1 does, have the learning rate of the configuration.",
    "Seconds count from the first step; loading, the start from the data (0.04 to 0.4 s) and the evaluation after the "
    "fit are not in them.",
    "Where no folder is given, phantoms in two groups, by their speckle, take the place of the paper's data sets.",
)
_NOTES = (
    "Reference is what was fitted, the filtered scan where noise was reduced, as in the paper: the gain says how much "
    "easier the reference is, and the noise-free column whether the field is any nearer to the tissue.",
    "The loss is the mean over the samples of a step. Interpolated samples carry less speckle than voxels, so it rises "
    "where the hybrid stage ends.",
    "30 dB after: the first report (four a second) at which the PSNR is there; a dash where it never is.",
)


def run(request: BenchmarkRequest, config: CurveBenchConfig | None = None) -> BenchmarkResult:
    """Measure the curves on the scans of the request, or on phantoms; one after the other, since time is measured.

    Raises:
        OctnError: the folder holds no scan, or a phantom's or the preset's name is unknown.
    """
    config = config or (QUICK if request.quick else CurveBenchConfig())
    began = time.perf_counter()
    fits = _fits(config)
    configuration = {"bench": as_plain(config), "fits": {start: as_plain(each) for start, each in fits.items()}}
    sources = scan_sources(request, config.phantoms, config.shape, config.seed)
    work = functools.partial(_measure, fits=fits, noise_reductions=config.noise_reductions, device=request.device)
    done = run_volumes(sources, work, request, name="curve", configuration=configuration, timed=True)
    sets = {source.name: source.data_set.name for source in sources if source.data_set is not None}
    rows = [{**row, "group": sets.get(row["volume"], row["group"])} for row in done.rows]
    own = [row for row in rows if row["start"] == next(iter(fits))]
    pictures = {}
    if rows:
        pictures = {
            "curve-training.png": training_curves([row for row in rows if row["noise_reduction"] == "raw"] or rows),
            "curve-distributions.png": distribution_boxes(own),
            "curve-noise-reduction.png": noise_reduction_boxes(own),
        }
    return BenchmarkResult(
        name="curve",
        title="loss and PSNR during a fit, and final quality over the scans",
        rows=rows,
        columns=filled_columns(rows, COLUMNS),
        paper=PAPER,
        deviations=_DEVIATIONS,
        notes=(*_NOTES, *_reached(rows), *_gains(own), *stated_spacings(sources, request), *done.notes),
        configuration=configuration,
        seeds={"tissue": config.seed, "speckle": config.seed, "fit": config.seed},
        seconds=time.perf_counter() - began,
        pictures=pictures,
    )


def _fits(config: CurveBenchConfig) -> dict[str, FitConfig]:
    """Return the fits by what they begin with: the preset as it is first, then with random features."""
    if config.preset not in PRESETS:
        raise ConfigurationError(f"preset: expected one of {', '.join(PRESETS)}, got {config.preset!r}")
    own = dataclasses.replace(PRESETS[config.preset], time_budget_s=config.seconds, seed=config.seed)
    fits = {FROM_DATA if own.start_from_data else RANDOM: own}
    if own.start_from_data and own.objective == "voxels":
        fits[RANDOM] = dataclasses.replace(own, start_from_data=False, learning_rate=config.random_rate)
    return fits


def _measure(scan: BenchScan, fits: dict[str, FitConfig], noise_reductions: Sequence[str], device: str) -> ScanResult:
    group = "scans" if scan.phantom is None else f"{scan.phantom.speckle} phantoms"
    rows: list[Row] = []
    for how in noise_reductions:
        volume = reduce_noise(scan.volume, how)
        for start, config in fits.items():
            if how != "raw" and start != next(iter(fits)):
                continue
            result = fit(volume, config, device=device)
            rows.append(
                {
                    "volume": scan.name,
                    "group": group,
                    "start": start,
                    "noise_reduction": how,
                    **curve_figures(result),
                    "psnr_db": result.psnr_db,
                    "ssim": _mean_ssim(result.field, volume),
                    "noise_free_psnr_db": None if scan.truth is None else psnr_of_field(result.field, scan.truth),
                    "steps": result.steps,
                    "seconds": result.seconds,
                }
            )
    return ScanResult(rows)


def curve_figures(result: FitResult) -> dict[str, Any]:
    """Return the curve of a fit, and the figures at its beginning, at the change of its stages, and at its end.

    A fit of one stage has none at the change; one that never is at 30 dB has no time for it.
    """
    reports = result.history
    figures: dict[str, Any] = {
        "curve_s": [report.seconds for report in reports],
        "curve_loss": [report.loss for report in reports],
        "curve_db": [report.psnr_db for report in reports],
        "curve_stage": [report.stage for report in reports],
        "acceptable_s": next((report.seconds for report in reports if report.psnr_db >= ACCEPTABLE_DB), None),
    }
    if reports:
        figures |= {"loss_first": reports[0].loss, "loss_last": reports[-1].loss, "curve_first_db": reports[0].psnr_db}
    hybrid = sum(report.stage == "hybrid" for report in reports)
    if 0 < hybrid < len(reports):
        last = reports[hybrid - 1]
        # A report carries the stage of its last step: the change came at most a quarter of a second before this one.
        figures |= {"switch_s": reports[hybrid].seconds, "loss_switch": last.loss, "curve_switch_db": last.psnr_db}
    return figures


def _mean_ssim(field: Field, volume: Volume) -> float:
    if min(volume.geometry.shape[1:]) < SSIM_WINDOW:
        return float("nan")
    each = [
        ssim(volume.normalized(bscan), render_bscans(field, np.array([bscan]))[0])
        for bscan in evaluated_bscans(volume.geometry).tolist()
    ]
    return float(np.mean(each))


def _reached(rows: Sequence[Row]) -> Iterator[str]:
    """Say how soon the fits are at 30 dB."""
    raw = [row for row in rows if row["noise_reduction"] == "raw"]
    for start in dict.fromkeys(row["start"] for row in raw):
        times = [row["acceptable_s"] for row in raw if row["start"] == start]
        reached = [seconds for seconds in times if seconds is not None]
        when = f", after {np.mean(reached):.1f} s in the mean, {max(reached):.1f} s at most" if reached else ""
        yield f"{start}: {len(reached)} of {len(times)} raw scans reach 30 dB{when}."


def _gains(own: Sequence[Row]) -> Iterator[str]:
    """Say what noise reduction before the fit is worth, for each group of scans."""
    for group in dict.fromkeys(row["group"] for row in own):
        raw = {row["volume"]: row for row in own if row["group"] == group and row["noise_reduction"] == "raw"}
        for how in dict.fromkeys(row["noise_reduction"] for row in own if row["noise_reduction"] != "raw"):
            pairs = [
                (row, raw[row["volume"]])
                for row in own
                if row["group"] == group and row["noise_reduction"] == how and row["volume"] in raw
            ]
            if not pairs:
                continue
            gain = np.mean([row["psnr_db"] - plain["psnr_db"] for row, plain in pairs])
            said = f"{group}, {how} before the fit: {gain:+.1f} dB and "
            said += (
                f"{np.mean([row['ssim'] - plain['ssim'] for row, plain in pairs]):+.3f} SSIM against its own reference"
            )
            if all(row["noise_free_psnr_db"] is not None for row, _ in pairs):
                true = np.mean([row["noise_free_psnr_db"] - plain["noise_free_psnr_db"] for row, plain in pairs])
                said += f", {true:+.1f} dB against the noise-free truth"
            yield f"{said}."
