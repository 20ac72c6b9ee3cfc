"""`octn bench band`: the paper's table 2 and figure 3, intensity bands from a field and from the raw voxels."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.evaluation.band_config import QUICK, BandBenchConfig
from octn_ros.evaluation.band_picture import band_picture
from octn_ros.evaluation.band_timing import middle_of
from octn_ros.evaluation.band_ways import Answer, Files, field_exhaustive, field_index, voxels_cpu, voxels_gpu
from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column, Row, filled_columns
from octn_ros.evaluation.engine import run_volumes
from octn_ros.evaluation.grid_comparison import render_bscans
from octn_ros.evaluation.kept_rows import ScanResult
from octn_ros.evaluation.preset_fit import preset_fit
from octn_ros.evaluation.scans import BenchScan, scan_sources, stated_spacings
from octn_ros.field import save_field
from octn_ros.metrics import cloud_distance
from octn_ros.query import PAPER_BANDS, BandQuery, Box, find_band, find_band_exhaustively
from octn_ros.settings import as_plain
from octn_ros.training import FitConfig, fit
from octn_ros.volume import save_volume

CPU, GPU = "voxels, CPU", "voxels, GPU"
EXHAUSTIVE, FIRST, REPEATED = "field, exhaustive", "field, index, first query", "field, index, repeated"
_BANDS = tuple(dataclasses.replace(query, max_points=1_000_000_000) for query in PAPER_BANDS)
_SECONDS = ("initialisation_s", "filtering_s", "masking_s", "transfer_s", "query_s", "total_s")
COLUMNS = (
    Column("volume", "scan"),
    Column("band", "band"),
    Column("way", "way"),
    Column("points", "points", "{:,}"),
    *(Column(key, f"{key[:-2]} s", "{:.4f}") for key in _SECONDS),
    Column("ratio_total_cpu", "CPU's total / this", "{:.3g}"),
    Column("paper_ratio_total_cpu", "paper", "{:.3g}"),
    Column("ratio_query_cpu", "CPU's query / this", "{:.3g}"),
    Column("paper_ratio_query_cpu", "paper", "{:.3g}"),
    Column("ratio_total_gpu", "GPU's total / this", "{:.3g}"),
    Column("paper_ratio_total_gpu", "paper", "{:.3g}"),
    Column("ratio_query_gpu", "GPU's query / this", "{:.3g}"),
    Column("chamfer_mm", "Chamfer mm", "{:.4f}"),
    Column("paper_chamfer_mm", "paper", "{:.4f}"),
    Column("hausdorff_mm", "Hausdorff mm", "{:.3f}"),
    Column("paper_hausdorff_mm", "paper", "{:.3f}"),
    Column("truth_chamfer_mm", "truth Chamfer mm", "{:.4f}"),
    Column("truth_hausdorff_mm", "truth Hausdorff mm", "{:.3f}"),
    Column("fit_psnr_db", "fit dB", "{:.1f}"),
)
# Table 2; the text of section III-A: 3 and 2 times faster in all, 19, 40 and 43 times in the query alone.
_PAPER = (
    {"chamfer_mm": 0.0423, "hausdorff_mm": 1.572, "ratio_query_cpu": 19.0},
    {"chamfer_mm": 0.0264, "hausdorff_mm": 1.451, "ratio_query_cpu": 40.0},
    {"chamfer_mm": 0.0158, "hausdorff_mm": 0.963, "ratio_query_cpu": 43.0},
)
_PAPER_ALL = {"ratio_total_cpu": 3.0, "ratio_total_gpu": 2.0}
_DEVIATIONS = (
    "Where no folder is given, phantoms take the place of the porcine TissueOCT sample, of the same number of voxels "
    "unless the run is quick.",
    "The field is fitted by the preset of the configuration; the paper's has 24 levels and is asked on an NVIDIA 4080 "
    "Super.",
    "The paper does not give its mask; here it is a square column in the middle of the scan, of all depths.",
    "The paper asks its field at every voxel; the rows with an index ask at the voxels of the mask, once, and keep the "
    "answers.",
    "Nearest neighbours are looked up in whole clouds for at most 100,000 points of each; the paper thins both clouds.",
)
_NOTES = (
    "Bands are half-open but for the last, so that no voxel counts twice; raw voxels are compared by raw values, "
    "without normalising them first.",
    "initialisation: the volume, uncompressed NIfTI, or the field's checkpoint, read from a file that the system has "
    "in memory, and brought to the device. A dash under masking: filtering has done it. A dash under transfer: all is "
    "in the CPU's memory.",
    "Seconds are of the run with the median total; compiling is not counted, fitting neither.",
    "A repeated query needs no initialisation: its total repeats the field's loading for the sake of the ratio.",
    "Chamfer, Hausdorff: between the points of the field and those of the raw voxels in the same band and mask; truth: "
    "between the row's points and those of the noise-free phantom. Where speckle decides which voxels lie in a band, a "
    "field that leaves speckle out differs from raw voxels for the better.",
)


def run(request: BenchmarkRequest, config: BandBenchConfig | None = None) -> BenchmarkResult:
    """Measure the table on the scans of the request, one after the other, or on phantoms.

    Raises:
        OctnError: the folder holds no scan, or the preset or a phantom's name is unknown.
    """
    config = config or (QUICK if request.quick else BandBenchConfig())
    began = time.perf_counter()
    fit_config = preset_fit(config.preset, config.steps, config.seed)
    sources = scan_sources(request, config.phantoms, config.shape, config.seed)
    configuration = {"bench": as_plain(config), "fit": as_plain(fit_config)}
    work = partial(_of_scan, config=config, fit_config=fit_config, device=request.device)
    scans = run_volumes(sources, work, request, name="band", configuration=configuration, timed=True)
    no_gpu = (
        ()
        if request.device.startswith("cuda")
        else ("There is no GPU: the rows of the raw voxels on one are left out.",)
    )
    return BenchmarkResult(
        name="band",
        title="intensity bands, from the file to the points",
        rows=scans.rows,
        columns=filled_columns(scans.rows, COLUMNS),
        paper=_paper_rows(),
        deviations=(*_DEVIATIONS, *no_gpu),
        notes=(*_NOTES, *stated_spacings(sources, request), *_verdicts(scans.rows), *scans.notes),
        configuration=configuration,
        seeds={"tissue": config.seed, "speckle": config.seed, "fit": config.seed},
        seconds=time.perf_counter() - began,
        pictures=scans.pictures,
    )


def _of_scan(scan: BenchScan, config: BandBenchConfig, fit_config: FitConfig, device: str) -> ScanResult:
    """Return the rows of one scan, band by band and way by way, and its picture."""
    fitted = fit(scan.volume, fit_config, device=device)
    mask = middle_of(scan.volume.geometry, config.side_m)
    find_band(fitted.field, _BANDS[-1], middle_of(scan.volume.geometry, 1e-4))  # compiles
    rows, notes = [], []
    with tempfile.TemporaryDirectory() as folder:
        files = Files(Path(folder) / "volume.nii", Path(folder) / "field.safetensors", device)
        save_volume(files.volume, scan.volume)
        save_field(files.field, fitted.field)
        for query, paper in zip(_BANDS, _PAPER, strict=True):
            answers = _answers(files, query, mask, config.repeats)
            truth = None if scan.truth is None else _points(scan, query, mask)
            voxels = answers[CPU].points_m
            for way, answer in answers.items():
                row: dict[str, Any] = {"volume": scan.name, "band": _name(query), "way": way}
                row["points"] = len(answer.points_m)
                row |= {key: getattr(answer, key) for key in _SECONDS} | _ratios(answers, answer)
                if way == EXHAUSTIVE:
                    row |= _distance(answer.points_m, voxels, "")
                    stated = {key: value for key, value in _PAPER_ALL.items() if key in row}
                    row |= {f"paper_{key}": value for key, value in (paper | stated).items()}
                    row["fit_psnr_db"] = fitted.psnr_db
                if truth is not None and way in (EXHAUSTIVE, CPU):
                    row |= _distance(answer.points_m, truth, "truth_")
                rows.append(row)
            different = _different(answers[EXHAUSTIVE].points_m, answers[REPEATED].points_m)
            if different:
                notes.append(
                    f"{scan.name}, {_name(query)}: {different} points are not the same with index and without."
                )
    bscan = scan.volume.geometry.shape[0] // 2
    images = {"raw voxels": scan.volume.normalized(bscan), "field": render_bscans(fitted.field, np.array([bscan]))[0]}
    if scan.truth is not None:
        images["noise-free"] = scan.truth.normalized(bscan)
    title = f"{scan.name}, B-scan {bscan}: bands {', '.join(_name(query) for query in _BANDS)}"
    picture = band_picture(title, images, scan.volume.geometry, rows)
    return ScanResult(rows, {f"band-{scan.file_name}.png": picture}, notes)


def _answers(files: Files, query: BandQuery, mask: Box, repeats: int) -> dict[str, Answer]:
    """Return each way's run of median total; ways take turns."""
    ways: dict[str, Callable[[Files, BandQuery, Box], Answer]] = {CPU: voxels_cpu}
    if files.device.startswith("cuda"):
        ways[GPU] = voxels_gpu
    ways[EXHAUSTIVE] = field_exhaustive
    runs: dict[str, list[Answer]] = {name: [] for name in (*ways, FIRST, REPEATED)}
    for _ in range(repeats):
        for name, way in ways.items():
            runs[name].append(way(files, query, mask))
        for name, answer in zip((FIRST, REPEATED), field_index(files, query, mask), strict=True):
            runs[name].append(answer)
    return {name: sorted(each, key=lambda answer: answer.total_s)[repeats // 2] for name, each in runs.items()}


def _points(scan: BenchScan, query: BandQuery, mask: Box) -> NDArray[np.float64]:
    assert scan.truth is not None
    return find_band_exhaustively(scan.truth, query, mask).points_m


def _ratios(answers: dict[str, Answer], answer: Answer) -> dict[str, float]:
    return {
        f"ratio_{what}_{place}": getattr(answers[other], f"{what}_s") / getattr(answer, f"{what}_s")
        for place, other in (("cpu", CPU), ("gpu", GPU))
        if other in answers
        for what in ("total", "query")
    }


def _distance(points: NDArray[np.float64], others: NDArray[np.float64], prefix: str) -> dict[str, float]:
    if not len(points) or not len(others):
        return {}
    distance = cloud_distance(points, others)
    return {f"{prefix}chamfer_mm": distance.chamfer_m * 1e3, f"{prefix}hausdorff_mm": distance.hausdorff_m * 1e3}


def _different(one: NDArray[np.float64], other: NDArray[np.float64]) -> int:
    """Return how many points are in one of two sets alone."""
    if np.array_equal(one, other):
        return 0
    first, second = (np.ascontiguousarray(points).view(np.dtype((np.void, 24))).ravel() for points in (one, other))
    return len(np.setxor1d(first, second, assume_unique=True))


def _name(query: BandQuery) -> str:
    return f"[{query.low:g}, {query.high:g}{')' if query.half_open else ']'}"


def _verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """Say how the ways compare over all rows, and where a band is empty."""
    for way in (EXHAUSTIVE, FIRST, REPEATED):
        own = [row for row in rows if row["way"] == way]
        if own:
            total, query = ([row[f"ratio_{what}_cpu"] for row in own] for what in ("total", "query"))
            yield (
                f"{way}: {min(total):.2g} to {max(total):.2g} times as fast as raw voxels on the CPU in all, "
                f"{min(query):.2g} to {max(query):.2g} times in the query alone."
            )
    empty = [f"{row['volume']} {row['band']} ({row['way']})" for row in rows if not row["points"]]
    if empty:
        yield f"Nothing lies in the band of {', '.join(empty)}."


def _paper_rows() -> list[dict[str, Any]]:
    source = "table 2; fig. 3 and section III-A"
    return [
        {"volume": "porcine muscle", "band": _name(query), "way": EXHAUSTIVE, **paper, **_PAPER_ALL, "source": source}
        for query, paper in zip(_BANDS, _PAPER, strict=True)
    ] + [
        {
            "volume": "porcine muscle",
            "way": EXHAUSTIVE,
            "filtering_s": 0.158,
            "masking_s": 0.0243,
            "source": "section III-A: inference at 67 million points; grid and conversion to metres",
        }
    ]
