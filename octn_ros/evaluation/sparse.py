"""`octn bench sparse`: the paper's figure 5, B-scans that were not measured, from a field and by interpolation."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column, Row, filled_columns
from octn_ros.evaluation.engine import run_volumes
from octn_ros.evaluation.grid_comparison import render_bscans
from octn_ros.evaluation.interpolators import PLAIN, choose_smoothing, smoothed
from octn_ros.evaluation.kept_rows import ScanResult
from octn_ros.evaluation.preset_fit import preset_fit
from octn_ros.evaluation.scans import BenchScan, scan_sources, stated_spacings
from octn_ros.evaluation.sparse_config import QUICK, SparseBenchConfig
from octn_ros.evaluation.sparse_judgement import SparseJudge
from octn_ros.evaluation.sparse_picture import sparse_curves, sparse_picture
from octn_ros.settings import as_plain
from octn_ros.training import FitConfig, fit
from octn_ros.volume import subsample_bscans

METHODS = ("field", "trilinear", "cubic", "smoothed")
_PSNR = [Column(f"{method}_psnr_db", f"{method} dB", "{:.2f}") for method in METHODS]
COLUMNS = (
    Column("volume", "scan"),
    Column("sf", "SF"),
    Column("kept", "B-scans kept"),
    *_PSNR,
    Column("field_psnr_sd_db", "field sd", "{:.2f}"),
    *(Column(f"{method}_grid_psnr_db", f"{method}, all B-scans dB", "{:.2f}") for method in METHODS),
    *(Column(f"{method}_truth_psnr_db", f"{method}, truth dB", "{:.1f}") for method in METHODS),
    *(Column(f"{method}_ssim", f"{method} SSIM", "{:.3f}") for method in METHODS),
    Column("chamfer_um", "field Chamfer um", "{:.1f}"),
    *(Column(f"{method}_chamfer_um", f"{method} Chamfer um", "{:.1f}") for method in METHODS[1:]),
    *(Column(f"{method}_truth_chamfer_um", f"{method}, truth Chamfer um", "{:.1f}") for method in METHODS),
    *(Column(f"{method}_truth_epi", f"{method}, truth EPI", "{:.3f}") for method in METHODS),
    *(Column(f"{method}_truth_rise", f"{method}, rise of edges", "{:.2f}") for method in METHODS),
    Column("sigma_voxels", "sigma voxels", "{:.1f}"),
    Column("seconds", "fit s", "{:.1f}"),
)
_DEVIATIONS = (
    "The paper compares with trilinear interpolation alone. Beside it stand a natural cubic spline along the slow "
    "axis, and trilinear interpolation after a Gaussian in the plane of the B-scans whose width is chosen on the kept "
    "B-scans.",
    "The field is fitted by the preset of the configuration, on the CPU unless a device is named, not by 24 levels on "
    "an NVIDIA 4080 Super.",
    "B-scans after the last kept one would have to be extrapolated and count in no figure.",
    "Where no folder is given, phantoms take the place of TissueOCT.",
)
_NOTES = (
    "dB: over the held-out B-scans against what was measured there, of which the speckle is in nobody's power; truth: "
    "against the noise-free phantom.",
    "All choices, the field's network and the Gaussian's width alike, are made on the kept B-scans alone.",
    "Chamfer: surfaces by eq. 3 after a Gaussian of one voxel, of the measured scan, or of the noise-free one (truth), "
    "on all B-scans. A kept B-scan that is only smoothed shares the measured one's speckle and its surface's errors.",
    "Rise of edges: across the true surface, from the voxel before it to the one after, over that of the noise-free "
    "scan; 1 where edges are as steep as they are.",
)
# Fig. 5 has no table: only what its text says.
_PAPER = (
    {
        "volume": "TissueOCT",
        "sf": "2 to 32",
        "source": "section III-C: the field matches or exceeds trilinear interpolation; blurring of fine features from "
        "SF 8 on; figures are drawn, not stated",
    },
)


def run(request: BenchmarkRequest, config: SparseBenchConfig | None = None) -> BenchmarkResult:
    """Measure the table on the scans of the request, or on phantoms.

    A scan that cannot be used at an SF, having too few B-scans, is said in the notes.

    Raises:
        OctnError: the folder holds no scan, or a phantom's name is unknown.
    """
    config = config or (QUICK if request.quick else SparseBenchConfig())
    began = time.perf_counter()
    fit_config = preset_fit(config.preset, config.steps, config.seed)
    sources = scan_sources(request, config.phantoms, config.shape, config.seed)
    configuration = {"bench": as_plain(config), "fit": as_plain(fit_config)}
    work = partial(_of_scan, config=config, fit_config=fit_config, device=request.device)
    scans = run_volumes(sources, work, request, name="sparse", configuration=configuration)
    rows, pictures = scans.rows, dict(scans.pictures)
    if rows:
        pictures["sparse-curves.png"] = sparse_curves(rows, METHODS)
    return BenchmarkResult(
        name="sparse",
        title="B-scans that were not measured, mean over each scan",
        rows=rows,
        columns=filled_columns(rows, COLUMNS),
        paper=_PAPER,
        deviations=_DEVIATIONS,
        notes=(*_NOTES, *_verdicts(rows), *stated_spacings(sources, request), *scans.notes),
        configuration=configuration,
        seeds={"tissue": config.seed, "speckle": config.seed, "fit": config.seed},
        seconds=time.perf_counter() - began,
        pictures=pictures,
    )


def _of_scan(scan: BenchScan, config: SparseBenchConfig, fit_config: FitConfig, device: str) -> ScanResult:
    """Return the rows of one scan and a picture for each."""
    rows, pictures, left_out = [], {}, []
    for factor in config.factors:
        kept_count = -(-scan.volume.geometry.shape[0] // factor)
        if kept_count < 4:
            left_out.append(
                f"{scan.name} at SF {factor} is left out: {kept_count} B-scans would be kept, 4 are needed."
            )
            continue
        sparse = subsample_bscans(scan.volume, factor)
        judge = SparseJudge(scan.volume, scan.truth, sparse)
        kept = sparse.volume.normalized(slice(None))
        positions = np.arange(judge.count) / factor
        result = fit(sparse.volume, fit_config, device=device)
        sigma = choose_smoothing(kept)
        row: dict[str, Any] = {"volume": scan.name, "sf": factor, "kept": kept_count}
        drawn = {}
        middle = sparse.held_out[len(sparse.held_out) // 2]
        for method in METHODS:
            if method == "field":
                reconstruction = render_bscans(result.field, positions)
            elif method == "smoothed":
                reconstruction = smoothed(kept, positions, sigma)
            else:
                reconstruction = PLAIN[method](kept, positions)
            figures = dataclasses.asdict(judge.judge(reconstruction))
            row |= {f"{method}_{key}": value for key, value in figures.items()}
            drawn[method] = reconstruction[middle]
        row |= {"chamfer_um": row["field_chamfer_um"], "sigma_voxels": sigma, "seconds": result.seconds}
        measured = scan.volume.normalized((middle,))
        rows.append(row)
        pictures[f"sparse-{scan.file_name}-sf{factor}.png"] = sparse_picture(
            f"{scan.name}, SF {factor}, B-scan {middle}", measured, drawn, scan.volume.geometry
        )
    return ScanResult(rows, pictures, left_out)


def _verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """Say where a baseline is better than the field, and by how much at most."""
    for method in METHODS[1:]:
        for key, of_what in (("psnr_db", "measured B-scans"), ("truth_psnr_db", "the truth")):
            lost = [
                (row[f"{method}_{key}"] - row[f"field_{key}"], row)
                for row in rows
                if row[f"{method}_{key}"] > row[f"field_{key}"]
            ]
            if lost:
                worst, row = max(lost, key=lambda pair: pair[0])
                yield (
                    f"{method} is nearer to {of_what} than the field in {len(lost)} of {len(rows)} rows, by "
                    f"{worst:.2f} dB at most ({row['volume']}, SF {row['sf']})."
                )
