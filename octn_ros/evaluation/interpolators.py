"""B-scans that were not measured, by interpolation of those that were: what a field is held against."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from octn_ros.errors import QueryError

Intensity = NDArray[np.float32]
# Widths in voxels that the smoothing is chosen from.
SIGMAS_VOXELS = (0.0, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)


def trilinear(bscans: Intensity, positions: NDArray[np.float64]) -> Intensity:
    """Return B-scans [position, axial, lateral] between measured ones [bscan, axial, lateral], linearly.

    Args:
        bscans: the measured ones, at least two.
        positions: where, counted in measured B-scans from 0; held at the ends.
    """
    held = np.clip(positions, 0.0, len(bscans) - 1.0)
    before = np.minimum(held.astype(np.int64), len(bscans) - 2)
    share = (held - before).astype(np.float32)[:, None, None]
    return (1.0 - share) * bscans[before] + share * bscans[before + 1]


def cubic(bscans: Intensity, positions: NDArray[np.float64]) -> Intensity:
    """Return the same on the natural cubic spline through the measured B-scans; with two of them it is a line."""
    held = np.clip(positions, 0.0, len(bscans) - 1.0)
    answer = np.empty((len(held), *bscans.shape[1:]), np.float32)
    for row in range(bscans.shape[1]):  # row by row: the coefficients are four doubles a voxel
        answer[:, row] = CubicSpline(np.arange(len(bscans)), bscans[:, row], axis=0, bc_type="natural")(held)
    return answer


def smoothed(bscans: Intensity, positions: NDArray[np.float64], sigma_voxels: float) -> Intensity:
    """Return `trilinear` of the measured B-scans after a Gaussian in the plane of each."""
    return trilinear(in_plane(bscans, sigma_voxels), positions)


def in_plane(bscans: Intensity, sigma_voxels: float) -> Intensity:
    """Return every B-scan after a Gaussian of `sigma_voxels` along both of its axes; 0 changes nothing."""
    if sigma_voxels == 0.0:
        return bscans
    return np.stack([gaussian_filter(bscan, sigma_voxels, mode="nearest") for bscan in bscans])


def choose_smoothing(bscans: Intensity, sigmas_voxels: Sequence[float] = SIGMAS_VOXELS) -> float:
    """Return the width of the Gaussian with which measured B-scans best predict each other.

    Each is predicted from the two beside it; no B-scan that was held out is seen.

    Raises:
        QueryError: there are fewer than three.
    """
    if len(bscans) < 3:
        raise QueryError(f"expected at least 3 measured B-scans to choose a smoothing on, got {len(bscans)}")
    return min(sigmas_voxels, key=lambda sigma: _prediction_error(in_plane(bscans, sigma), bscans))


def _prediction_error(filtered: Intensity, measured: Intensity) -> float:
    difference = 0.5 * (filtered[:-2] + filtered[2:]) - measured[1:-1]
    return float(np.vdot(difference, difference))


# The interpolations that need no choice, by name.
PLAIN: dict[str, Callable[[Intensity, NDArray[np.float64]], Intensity]] = {"trilinear": trilinear, "cubic": cubic}
