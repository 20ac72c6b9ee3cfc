"""How good B-scans that were not measured are: each method's figures for one scan and one SF."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.evaluation.grid_comparison import SURFACE_SIGMA_VOXELS, surface_points_m
from octn_ros.metrics import SSIM_WINDOW, cloud_distance, edge_preservation_index, psnr_from_error_db, ssim
from octn_ros.query import native_surface
from octn_ros.volume import SparseScan, Volume, gaussian_filter

Intensity = NDArray[np.float32]


@dataclass(frozen=True)
class Figures:
    """One method on one sparse scan; NaN where a figure has no meaning.

    Attributes:
        psnr_db: over all voxels of the held-out B-scans, against what was measured there.
        psnr_sd_db: standard deviation of the PSNR of single held-out B-scans.
        grid_psnr_db: over all B-scans from the first to the last kept one, kept ones included (fig. 5b).
        ssim: mean over the held-out B-scans.
        chamfer_um: between the surfaces of the measured scan and of the reconstruction, both by eq. 3 after a Gaussian
            of one voxel, on all these B-scans (fig. 5d).
        truth_psnr_db: over the held-out B-scans, against the noise-free scan.
        truth_epi: edge preservation index against the noise-free scan there.
        truth_chamfer_um: between the surfaces of the noise-free scan and of the reconstruction.
        truth_rise: mean rise from the voxel before the noise-free scan's surface to the one after it, over that of the
            noise-free scan, on the held-out B-scans: 1 where edges are as steep. Noise, which no edge preservation
            index tells from edges, adds nothing to it.
    """

    psnr_db: float
    psnr_sd_db: float
    grid_psnr_db: float
    ssim: float
    chamfer_um: float
    truth_psnr_db: float = np.nan
    truth_epi: float = np.nan
    truth_chamfer_um: float = np.nan
    truth_rise: float = np.nan


class SparseJudge:
    """Holds reconstructions of a sparse scan against the whole one; keeps what is common to all of them.

    Args:
        volume: the whole scan.
        truth: the same without noise, None if nobody knows.
        sparse: which B-scans of it were kept.
    """

    def __init__(self, volume: Volume, truth: Volume | None, sparse: SparseScan) -> None:
        self.count = sparse.kept[-1] + 1
        self._held_out = np.array(sparse.held_out)
        self._volume = volume
        self._measured = volume.normalized(slice(self.count))
        self._surface = self._points(self._measured)
        self._truth = None if truth is None else truth.normalized(slice(self.count))
        self._true_surface = None if self._truth is None else self._points(self._truth)

    def judge(self, reconstruction: Intensity) -> Figures:
        """Return the figures of all B-scans from the first to the last kept one, [bscan, axial, lateral]."""
        errors = _squared_errors(self._measured, reconstruction)
        held_out = errors[self._held_out]
        surface = self._points(reconstruction)
        figures = Figures(
            psnr_db=psnr_from_error_db(float(held_out.mean())),
            psnr_sd_db=float(np.std([psnr_from_error_db(float(error)) for error in held_out])),
            grid_psnr_db=psnr_from_error_db(float(errors.mean())),
            ssim=self._ssim(reconstruction),
            chamfer_um=cloud_distance(self._surface, surface).chamfer_m * 1e6,
        )
        if self._truth is None or self._true_surface is None:
            return figures
        truth, guess = self._truth[self._held_out], reconstruction[self._held_out]
        depth = self._depth(self._true_surface)[self._held_out]
        edges = (edge_preservation_index(*pair) for pair in zip(truth, guess, strict=True))
        return dataclasses.replace(
            figures,
            truth_psnr_db=psnr_from_error_db(float(_squared_errors(truth, guess).mean())),
            truth_epi=_mean(edges),
            truth_chamfer_um=cloud_distance(self._true_surface, surface).chamfer_m * 1e6,
            truth_rise=_rise(guess, depth) / _rise(truth, depth),
        )

    def _points(self, intensity: Intensity) -> NDArray[np.float64]:
        geometry = dataclasses.replace(self._volume.geometry, shape=intensity.shape)
        scan = dataclasses.replace(self._volume, array=intensity, geometry=geometry, intensity_range=(0.0, 1.0))
        points = native_surface(gaussian_filter(scan, SURFACE_SIGMA_VOXELS))
        return surface_points_m(scan, self._depth(points))

    def _depth(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the axial index [bscan, lateral] of surface points on the scan's grid."""
        geometry = self._volume.geometry
        return np.float64(geometry.metric_to_voxel(points)[..., 1]).reshape(-1, geometry.shape[2])

    def _ssim(self, reconstruction: Intensity) -> float:
        if min(reconstruction.shape[1:]) < SSIM_WINDOW:
            return float("nan")
        return _mean(ssim(self._measured[bscan], reconstruction[bscan]) for bscan in self._held_out.tolist())


def _squared_errors(one: Intensity, other: Intensity) -> NDArray[np.float64]:
    """Return the mean squared error of every B-scan."""
    return np.array([np.mean(np.square(a - b), dtype=np.float64) for a, b in zip(one, other, strict=True)])


def _rise(intensity: Intensity, depth: NDArray[np.float64]) -> float:
    """Return the mean rise over two voxels along the beam at the axial index [bscan, lateral] in each A-scan."""
    row = np.rint(depth).astype(np.int64).clip(1, intensity.shape[1] - 2)[:, None]
    return float(
        (np.take_along_axis(intensity, row + 1, axis=1) - np.take_along_axis(intensity, row - 1, axis=1)).mean()
    )


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
