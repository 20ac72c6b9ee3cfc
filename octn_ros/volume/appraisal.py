"""A first look at a C-scan: intensity histogram, where the surface lies, how far tissue stands out of the noise.

Estimates from the voxels alone, quick and without a model; `octn_ros.query` finds the surface properly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.volume.volume import Volume

_MAX_BSCANS = 64  # the estimates are taken from at most so many B-scans, evenly spread
_LATERAL_SIGMA_VOXELS = 2.0
_AXIAL_SIGMA_VOXELS = 2.0
_GUARD_VOXELS = 5  # rows on either side of the surface that are neither air nor tissue: blur and specular reflection
_TISSUE_VOXELS = 20  # rows of tissue below the guard
_MIN_VOXELS = 100  # fewer voxels of air or of tissue tell nothing


@dataclass(frozen=True)
class Appraisal:
    """What the voxels of a C-scan show; immutable.

    Attributes:
        surface_row: median axial index of the strongest smoothed rise of the A-scans.
        surface_row_range: 5th and 95th percentile of these indices.
        snr_db: 20 log10((mean tissue - mean air) / standard deviation of air) of normalised intensities; NaN where
            there is too little air above the surface, or tissue does not stand out of its noise (below 0 dB).
    """

    surface_row: float
    surface_row_range: tuple[float, float]
    snr_db: float


def histogram(volume: Volume, bins: int = 16) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return how many voxels lie in each of `bins` equal parts between the smallest and the largest raw value.

    Returns:
        counts [bins] and the edges [bins + 1] in raw values.
    """
    low, high = float(volume.array.min()), float(volume.array.max())
    counts = np.zeros(bins, np.int64)
    for bscan in volume.array:  # one at a time: the function works on copies of its argument
        counts += np.histogram(bscan, bins, (low, high))[0]
    return counts, np.linspace(low, high, bins + 1)


def appraise(volume: Volume) -> Appraisal:
    """Estimate where the surface lies and the signal-to-noise ratio, from at most 64 evenly spread B-scans.

    Each B-scan is smoothed by a Gaussian of 2 voxels; the surface of an A-scan is its largest axial rise. Air is what
    lies more than 5 rows above it, tissue the 20 rows that begin 5 rows below it.
    """
    bscans = volume.geometry.shape[0]
    chosen = np.unique(np.linspace(0, bscans - 1, min(bscans, _MAX_BSCANS)).round().astype(int))
    low, high = volume.intensity_range
    rows = []
    air, tissue = _Moments(), _Moments()
    for index in chosen:
        bscan = np.clip((volume.array[index].astype(np.float32) - low) / (high - low), 0.0, 1.0)
        row = _surface_rows(bscan)
        depth = np.arange(bscan.shape[0])[:, None] - row[None, :]
        air.add(bscan[depth < -_GUARD_VOXELS])
        tissue.add(bscan[(depth >= _GUARD_VOXELS) & (depth < _GUARD_VOXELS + _TISSUE_VOXELS)])
        rows.append(row)
    all_rows = np.concatenate(rows)
    first, last = np.percentile(all_rows, (5, 95))
    return Appraisal(float(np.median(all_rows)), (float(first), float(last)), _snr_db(air, tissue))


class _Moments:
    """Count, mean and standard deviation of numbers that come in portions."""

    def __init__(self) -> None:
        self.count, self._sum, self._squares = 0, 0.0, 0.0

    def add(self, values: NDArray[np.float32]) -> None:
        self.count += values.size
        self._sum += float(values.sum(dtype=np.float64))
        self._squares += float(np.square(values, dtype=np.float64).sum())

    @property
    def mean(self) -> float:
        return self._sum / self.count

    @property
    def deviation(self) -> float:
        return math.sqrt(max(0.0, self._squares / self.count - self.mean**2))


def _surface_rows(bscan: NDArray[np.float32]) -> NDArray[np.float64]:
    smooth = ndimage.gaussian_filter(bscan, (_AXIAL_SIGMA_VOXELS, _LATERAL_SIGMA_VOXELS), mode="nearest")
    rise = np.diff(smooth, axis=0)
    return rise.argmax(axis=0) + 0.5  # a difference lies between its two rows


def _snr_db(air: _Moments, tissue: _Moments) -> float:
    if min(air.count, tissue.count) < _MIN_VOXELS or air.deviation == 0.0 or tissue.mean - air.mean <= air.deviation:
        return math.nan
    return 20.0 * math.log10((tissue.mean - air.mean) / air.deviation)
