"""`octn bench compare`: the paper's table 5, fields of this package against other representations."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column, Row, filled_columns
from octn_ros.evaluation.compare_config import QUICK, CompareBenchConfig
from octn_ros.evaluation.compare_picture import compare_picture
from octn_ros.evaluation.engine import run_volumes
from octn_ros.evaluation.grid_comparison import render_bscans
from octn_ros.evaluation.interpolators import PLAIN
from octn_ros.evaluation.kept_rows import ScanResult
from octn_ros.evaluation.rival_fields import RIVALS
from octn_ros.evaluation.rival_training import fit_rival, render_rival
from octn_ros.evaluation.scans import BenchScan, scan_sources, stated_spacings
from octn_ros.metrics import SSIM_WINDOW, psnr_db, ssim
from octn_ros.settings import as_plain
from octn_ros.training import PRESETS, FitConfig, fit
from octn_ros.volume import SparseScan, subsample_bscans

Intensity = NDArray[np.float32]
Render = Callable[[NDArray[np.float64]], Intensity]
COLUMNS = (
    Column("volume", "scan"),
    Column("budget", "the same"),
    Column("method", "method"),
    Column("fitted_psnr_db", "fitted B-scans dB", "{:.2f}"),
    Column("paper_psnr_db", "paper", "{:.2f}"),
    Column("fitted_ssim", "fitted SSIM", "{:.3f}"),
    Column("paper_ssim", "paper", "{:.2f}"),
    Column("held_out_psnr_db", "held-out dB", "{:.2f}"),
    Column("held_out_ssim", "held-out SSIM", "{:.3f}"),
    Column("fitted_truth_psnr_db", "fitted, truth dB", "{:.2f}"),
    Column("fitted_truth_ssim", "fitted, truth SSIM", "{:.3f}"),
    Column("held_out_truth_psnr_db", "held-out, truth dB", "{:.2f}"),
    Column("held_out_truth_ssim", "held-out, truth SSIM", "{:.3f}"),
    Column("seconds", "fit s", "{:.1f}"),
    Column("samples", "samples", "{:,}"),
    Column("steps", "steps", "{:,}"),
    Column("parameters", "parameters", "{:,}"),
)
# Table 5: PSNR in dB and SSIM.
PAPER = {
    "Srinivasan": {"cunerf": (12.98, 0.38), "OCTN": (41.99, 0.97)},
    "Harvard GDP": {"cunerf": (24.70, 0.48), "OCTN": (44.55, 0.99)},
    "Noor": {"cunerf": (19.62, 0.30), "OCTN": (45.95, 0.99)},
    "TissueOCT": {"cunerf": (23.82, 0.69), "OCTN": (35.09, 0.84)},
}
_PAPER_SECONDS = {"cunerf": 394 * 60.0, "OCTN": 171.0}
_PAPER_STEPS = {"cunerf": 250_000, "OCTN": 2500}
_DEVIATIONS = (
    "The paper fits every B-scan and reports evenly spaced ones of them: that is the column of fitted B-scans. Here "
    "every second one is fitted (the configuration's factor), so that interpolations, which are perfect where they "
    "were given the voxels, can be compared on those held out.",
    "CuNeRF is its network, fitted to single voxels at its published learning rates and batch: its cubes of 64 + 64 "
    "samples for each voxel would make every step 128 times as dear.",
    "The paper lets OCTN run for 171 s and CuNeRF for 394 min, on an NVIDIA 4080 Super; here all have the same "
    "seconds, or the same samples, far fewer than either.",
    "SIREN and the interpolations are not in the paper.",
    "The preset paper draws the configuration's batch, since a CPU takes minutes for a step of 262,144 samples.",
    "Where no folder is given, phantoms take the place of the paper's sets; the paper's figures beside them are those "
    "of TissueOCT.",
)
_NOTES = (
    "fitted: against the measured B-scans that were fitted, speckle included, so that who learns the speckle wins; "
    "held-out: against measured ones that nobody was given; truth: against the noise-free phantom there.",
    "Where seconds are the same, the fits of this package end by that clock, and the others run for as long as the "
    "longest of these took with everything, start from the data and closing evaluation included.",
    "seconds are of the whole fit. samples: voxels drawn; a start from the data, which fast and sparse have, reads the "
    "whole volume once and counts as none.",
    "A fit that is given a fraction of its usual steps is no judgement of the method at its best: read the rows as "
    "what comes out of so many seconds, or samples, here.",
)


def run(request: BenchmarkRequest, config: CompareBenchConfig | None = None) -> BenchmarkResult:
    """Measure the table on the scans of the request, or on phantoms.

    Raises:
        OctnError: the folder holds no scan, or a phantom's name is unknown.
    """
    config = config or (QUICK if request.quick else CompareBenchConfig())
    began = time.perf_counter()
    sources = scan_sources(request, config.phantoms, config.shape, config.seed)
    configuration = {
        "bench": as_plain(config),
        "presets": {name: as_plain(PRESETS[name]) for name in config.presets},
        "rivals": {
            name: {key: getattr(RIVALS[name], key) for key in ("learning_rate", "final_rate_ratio", "batch", "source")}
            for name in config.rivals
        },
    }
    work = functools.partial(_of_scan, config=config, device=request.device)
    scans = run_volumes(sources, work, request, name="compare", configuration=configuration)
    return BenchmarkResult(
        name="compare",
        title="other representations of the same B-scans",
        rows=scans.rows,
        columns=filled_columns(scans.rows, COLUMNS),
        paper=_paper_rows(),
        deviations=_DEVIATIONS,
        notes=(*_NOTES, *stated_spacings(sources, request), *_verdicts(scans.rows), *scans.notes),
        configuration=configuration,
        seeds={"tissue": config.seed, "speckle": config.seed, "fit": config.seed},
        seconds=time.perf_counter() - began,
        pictures=scans.pictures,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Fitted:
    """A representation of the kept B-scans, and what it cost."""

    render: Render
    parameters: int
    seconds: float = 0.0
    samples: int | None = None
    steps: int | None = None


def _of_scan(scan: BenchScan, config: CompareBenchConfig, device: str) -> ScanResult:
    """Return the rows of one scan and its picture."""
    sparse = subsample_bscans(scan.volume, config.factor)
    judge = HeldOutJudge(scan, sparse, config.judged_bscans)
    rows, drawn = [], {"measured": scan.volume.normalized(judge.shown)}
    if scan.truth is not None:
        drawn["noise-free"] = scan.truth.normalized(judge.shown)
    for budget, method, fitted in _fits(sparse, config, device):
        row: dict[str, Any] = {"volume": scan.name, "budget": budget, "method": method}
        row |= judge.judge(fitted.render)
        row |= {key: getattr(fitted, key) for key in ("seconds", "samples", "steps", "parameters")}
        ours = "OCTN" if method in config.presets else method
        known = next((figures for name, figures in PAPER.items() if scan.name.startswith(name)), PAPER["TissueOCT"])
        if ours in known:
            row["paper_psnr_db"], row["paper_ssim"] = known[ours]
        rows.append(row)
        if budget in ("none", config.budgets[0]):
            drawn[method] = fitted.render(np.array([judge.shown / config.factor]))[0]
    same = f"the same {config.budgets[0]}" if config.budgets else "interpolated"
    title = f"{scan.name}, held-out B-scan {judge.shown}, {same}"
    picture = compare_picture(title, drawn, scan.volume.geometry)
    return ScanResult(rows, {f"compare-{scan.file_name}.png": picture})


def _fits(sparse: SparseScan, config: CompareBenchConfig, device: str) -> Iterator[tuple[str, str, _Fitted]]:
    """Yield budget, method and fit of every representation; no more than one of them is held at a time."""
    for budget in config.budgets:
        longest = config.seconds
        for preset in config.presets:
            began = time.perf_counter()
            result = fit(sparse.volume, _fit_config(preset, budget, config), device=device)
            seconds = time.perf_counter() - began
            longest = max(longest, seconds)
            field, training = result.field, result.field.description.training
            parameters = sum(parameter.numel() for parameter in field.model.parameters())
            render = functools.partial(render_bscans, field)
            samples = None if training is None else int(training["samples"])
            yield budget, preset, _Fitted(render, parameters, seconds, samples, result.steps)
        for name in config.rivals:
            until = {"seconds": longest} if budget == "seconds" else {"samples": config.samples}
            rival = fit_rival(RIVALS[name], sparse.volume, device=device, seed=config.seed, **until)
            parameters = sum(parameter.numel() for parameter in rival.model.parameters())
            render = functools.partial(_rendered, rival.model, sparse, device)
            yield budget, name, _Fitted(render, parameters, rival.seconds, rival.samples, rival.steps)
    kept = sparse.volume.normalized()
    for name, interpolate in PLAIN.items():
        yield "none", name, _Fitted(functools.partial(interpolate, kept), kept.size)


def _rendered(model: Any, sparse: SparseScan, device: str, positions: NDArray[np.float64]) -> Intensity:
    return render_rival(model, sparse.volume.geometry, positions, device)


def _fit_config(preset: str, budget: str, config: CompareBenchConfig) -> FitConfig:
    values = dataclasses.replace(PRESETS[preset], seed=config.seed)
    if preset == "paper":
        values = dataclasses.replace(values, batch=config.paper_batch)
    if budget == "samples":
        batch = min(values.batch, config.samples)
        return dataclasses.replace(values, time_budget_s=0.0, batch=batch, steps=max(1, config.samples // batch))
    # Enough steps for the clock to be what ends it.
    return dataclasses.replace(values, time_budget_s=config.seconds, steps=10_000_000)


class HeldOutJudge:
    """Holds representations of a sparse scan against evenly spaced B-scans, those it was fitted to and the others.

    Args:
        scan: the whole scan.
        sparse: which B-scans of it were kept.
        count: how many of either kind are looked at, at most.
    """

    def __init__(self, scan: BenchScan, sparse: SparseScan, count: int) -> None:
        self._scan, self._factor = scan, sparse.factor
        self._bscans = {"fitted": _evenly(sparse.kept, count), "held_out": _evenly(sparse.held_out, count)}
        # The B-scan that a picture shows.
        self.shown = sparse.held_out[len(sparse.held_out) // 2]

    def judge(self, render: Render) -> dict[str, float]:
        """Return PSNR over all voxels and mean SSIM, on either kind, against what was measured and against the truth.

        Args:
            render: gives intensities [position, axial, lateral] at positions counted in kept B-scans.
        """
        figures = {}
        for kind, bscans in self._bscans.items():
            answer = render(np.array(bscans) / self._factor)
            references = {"": self._scan.volume}
            if self._scan.truth is not None:
                references["_truth"] = self._scan.truth
            for suffix, volume in references.items():
                reference = volume.normalized(list(bscans))
                figures[f"{kind}{suffix}_psnr_db"] = psnr_db(reference, answer)
                figures[f"{kind}{suffix}_ssim"] = _mean_ssim(reference, answer)
        return figures


def _evenly(bscans: Sequence[int], count: int) -> list[int]:
    chosen = np.linspace(0, len(bscans) - 1, min(count, len(bscans))).round().astype(int)
    return [bscans[index] for index in chosen]


def _mean_ssim(reference: Intensity, answer: Intensity) -> float:
    if min(reference.shape[1:]) < SSIM_WINDOW:
        return math.nan
    return float(np.mean([ssim(one, other) for one, other in zip(reference, answer, strict=True)]))


def _verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """Say for each budget what each method reaches on held-out B-scans, the best first."""
    for budget in dict.fromkeys(row["budget"] for row in rows if row["budget"] != "none"):
        for key, of_what in (("held_out_psnr_db", "measured"), ("held_out_truth_psnr_db", "noise-free")):
            entries: dict[str, list[float]] = {}
            for row in rows:
                if row["budget"] in (budget, "none") and row.get(key) is not None:
                    entries.setdefault(row["method"], []).append(row[key])
            if entries:
                means = sorted(((float(np.mean(each)), name) for name, each in entries.items()), reverse=True)
                said = ", ".join(f"{name} {mean:.2f}" for mean, name in means)
                yield f"With the same {budget}, dB on held-out B-scans against the {of_what} ones, mean: {said}."


def _paper_rows() -> list[dict[str, Any]]:
    return [
        {
            "volume": volume,
            "method": method,
            "fitted_psnr_db": psnr,
            "fitted_ssim": similarity,
            "seconds": _PAPER_SECONDS[method],
            "steps": _PAPER_STEPS[method],
            "source": "table 5",
        }
        for volume, figures in PAPER.items()
        for method, (psnr, similarity) in figures.items()
    ]
