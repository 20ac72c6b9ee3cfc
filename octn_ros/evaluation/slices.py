"""`octn bench slices`: the paper's intermediate B-scans, a quarter, half and three quarters of the way to the next."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column, Row, filled_columns
from octn_ros.evaluation.engine import run_volumes
from octn_ros.evaluation.fractional import QUARTERS, anchor_bscan, proxy_bscans, true_bscans
from octn_ros.evaluation.grid_comparison import render_bscans
from octn_ros.evaluation.kept_rows import ScanResult
from octn_ros.evaluation.preset_fit import preset_fit
from octn_ros.evaluation.scans import BenchScan, scan_sources, stated_spacings
from octn_ros.evaluation.slices_config import QUICK, SlicesBenchConfig
from octn_ros.evaluation.slices_picture import slices_picture
from octn_ros.metrics import psnr_db
from octn_ros.settings import as_plain
from octn_ros.training import FitConfig, fit

TRILINEAR = "trilinear"
COLUMNS = (
    Column("volume", "scan"),
    Column("method", "method"),
    Column("alpha", "alpha", "{:.1f}"),
    Column("anchor", "D/2", "{:.0f}"),
    Column("grid_psnr_db", "at the anchors dB", "{:.2f}"),
    *(Column(f"psnr_{quarter:g}_db", f"+{quarter:g} dB", "{:.2f}") for quarter in QUARTERS),
    Column("psnr_db", "between, mean dB", "{:.2f}"),
    *(Column(f"truth_{quarter:g}_psnr_db", f"+{quarter:g}, truth dB", "{:.2f}") for quarter in QUARTERS),
    Column("truth_psnr_db", "between, truth dB", "{:.2f}"),
    Column("grid_truth_psnr_db", "at the anchors, truth dB", "{:.2f}"),
    Column("seconds", "fit s", "{:.1f}"),
)
# The paper states a fractional figure in table 4 alone, for position 128.5.
_PAPER = (
    {"volume": "TissueOCT", "method": "OCTN", "alpha": 0.0, "psnr_0.5_db": 22.86, "source": "table 4, 128.5"},
    {"volume": "TissueOCT", "method": "OCTN", "alpha": 0.2, "psnr_0.5_db": 27.19, "source": "table 4, 128.5"},
)
_DEVIATIONS = (
    "The paper shows one TissueOCT volume, fitted with 24 levels on an NVIDIA 4080 Super; here the presets of the "
    "configuration, on the CPU unless a device is named.",
    "Where no folder is given, phantoms take the place of TissueOCT.",
    "The noise-free truth between the B-scans, which only a phantom has, is not in the paper.",
)
_NOTES = (
    "dB: against trilinear interpolation of the measured B-scans, which stands in for a measurement that does not "
    "exist. It carries the speckle of both neighbours, so a field that leaves the speckle out is marked down for it.",
    "truth: against the noise-free tissue between the B-scans, from a phantom with four times the B-scans of the same "
    "tissue. There trilinear interpolation itself has a figure.",
    "A preset that learns from neighbouring B-scans draws no interpolated samples: it has one row, without alpha.",
)


def run(request: BenchmarkRequest, config: SlicesBenchConfig | None = None) -> BenchmarkResult:
    """Measure the table on the scans of the request, or on phantoms.

    Raises:
        OctnError: the folder holds no scan, or a phantom's or a preset's name is unknown.
    """
    config = config or (QUICK if request.quick else SlicesBenchConfig())
    began = time.perf_counter()
    fits = _fits(config)
    configuration = {"bench": as_plain(config), "fits": [as_plain(each) for each, _ in fits]}
    sources = scan_sources(request, config.phantoms, config.shape, config.seed)
    work = functools.partial(_measure, fits=fits, device=request.device)
    done = run_volumes(sources, work, request, name="slices", configuration=configuration)
    return BenchmarkResult(
        name="slices",
        title="B-scans at quarters of the way between the two middle ones",
        rows=done.rows,
        columns=filled_columns(done.rows, COLUMNS),
        paper=_PAPER,
        deviations=_DEVIATIONS,
        notes=(*_NOTES, *_verdicts(done.rows), *stated_spacings(sources, request), *done.notes),
        configuration=configuration,
        seeds={"tissue": config.seed, "speckle": config.seed, "fit": config.seed},
        seconds=time.perf_counter() - began,
        pictures=done.pictures,
    )


def _measure(scan: BenchScan, fits: Sequence[tuple[FitConfig, float | None]], device: str) -> ScanResult:
    judge = _SliceJudge(scan)
    rows = [judge.row(TRILINEAR, None, judge.proxy_with_anchors())]
    drawn = {TRILINEAR: judge.proxy}
    for config, alpha in fits:
        result = fit(scan.volume, config, device=device)
        rendered = render_bscans(result.field, judge.positions)
        rows.append(judge.row(config.preset, alpha, rendered) | {"seconds": result.seconds})
        drawn[_title(rows[-1])] = rendered[1:-1]
    picture = slices_picture(scan.name, judge.positions[1:-1], drawn, judge.truth, scan.volume.geometry)
    return ScanResult(rows, {f"slices-{scan.file_name}.png": picture})


def _fits(config: SlicesBenchConfig) -> list[tuple[FitConfig, float | None]]:
    """Return the fits of all presets with their alpha; None for a preset that draws no interpolated samples."""
    fits: list[tuple[FitConfig, float | None]] = []
    for preset in config.presets:
        plain = preset_fit(preset, config.steps, config.seed)
        if plain.objective == "neighbours":
            fits.append((plain, None))
        else:
            fits += [(dataclasses.replace(plain, alpha=alpha), alpha) for alpha in config.alphas]
    return fits


class _SliceJudge:
    """Holds reconstructions of the two anchors and of the three B-scans between them against proxy and truth."""

    def __init__(self, scan: BenchScan) -> None:
        self.scan = scan
        self.anchor = anchor_bscan(scan.volume)
        self.positions = self.anchor + np.array([0.0, *QUARTERS, 1.0])
        self._anchors = slice(self.anchor, self.anchor + 2)
        self._measured = scan.volume.normalized(self._anchors)
        self.proxy = proxy_bscans(scan.volume, self.anchor)
        self.truth = None if scan.phantom is None else true_bscans(scan.phantom, self.anchor)
        self._true_anchors = None if scan.truth is None else scan.truth.normalized(self._anchors)

    def proxy_with_anchors(self) -> NDArray[np.float32]:
        """Return what trilinear interpolation has at all positions."""
        return np.concatenate([self._measured[:1], self.proxy, self._measured[1:]])

    def row(self, method: str, alpha: float | None, rendered: NDArray[np.float32]) -> dict[str, Any]:
        """Return the figures of B-scans [5, axial, lateral] at the positions; trilinear has none against itself."""
        row: dict[str, Any] = {"volume": self.scan.name, "method": method, "alpha": alpha, "anchor": self.anchor}
        between, anchors = rendered[1:-1], rendered[[0, -1]]
        if method != TRILINEAR:
            row |= {"grid_psnr_db": psnr_db(self._measured, anchors), "psnr_db": psnr_db(self.proxy, between)}
            for quarter, proxy, image in zip(QUARTERS, self.proxy, between, strict=True):
                row[f"psnr_{quarter:g}_db"] = psnr_db(proxy, image)
        if self.truth is not None:
            row["truth_psnr_db"] = psnr_db(self.truth, between)
            for quarter, truth, image in zip(QUARTERS, self.truth, between, strict=True):
                row[f"truth_{quarter:g}_psnr_db"] = psnr_db(truth, image)
        if self._true_anchors is not None:
            row["grid_truth_psnr_db"] = psnr_db(self._true_anchors, anchors)
        return row


def _title(row: Row) -> str:
    return str(row["method"]) if row["alpha"] is None else f"{row['method']}, alpha {row['alpha']:g}"


def _verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """Say for each method how far from the truth it is between the B-scans, beside trilinear and beside the anchors."""
    plain = {row["volume"]: row for row in rows if row["method"] == TRILINEAR and "truth_psnr_db" in row}
    for title in dict.fromkeys(_title(row) for row in rows if row["method"] != TRILINEAR):
        mine = [row for row in rows if _title(row) == title and row["volume"] in plain]
        if mine:
            gains = [row["truth_psnr_db"] - plain[row["volume"]]["truth_psnr_db"] for row in mine]
            falls = [row["truth_psnr_db"] - row["grid_truth_psnr_db"] for row in mine]
            yield (
                f"{title}: between the B-scans {np.mean(gains):+.1f} dB nearer to the truth than trilinear "
                f"interpolation in the mean, {min(gains):+.1f} dB at worst; against its own B-scans at the anchors "
                f"{np.mean(falls):+.1f} dB."
            )
