"""How far points lie from a surface that is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError

# Depth z [N] in metres of the true surface at x [N], y [N], all in the OCT frame.
SurfaceDepth = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
# Half a nanometre would drown in rounding, half a voxel would round off a wave; a micrometre does neither.
_SLOPE_STEP_M = 1e-6


@dataclass(frozen=True)
class SurfaceDistance:
    """Signed distance of points to a known surface; positive lies deeper in the tissue.

    Attributes:
        offset_um: median distance, which a calibration can take away.
        spread_um: root mean square about the median, which it cannot.
        max_um: largest absolute distance.
        rms_um: root mean square distance, offset and spread together.
    """

    offset_um: float
    spread_um: float
    max_um: float
    rms_um: float


def surface_distance(points_m: NDArray[np.floating], surface_depth_m: SurfaceDepth) -> SurfaceDistance:
    """Distance of points to the nearest point of the true surface, to first order in the distance.

    The axial difference is shortened by the cosine of the local slope, exact on planes and good to a few per cent
    where the distance is small against the surface's radius of curvature.

    Args:
        points_m: points [N, (x, y, z)] in the OCT frame.
        surface_depth_m: depth of the true surface as a function of x [N] and y [N], vectorised.

    Raises:
        QueryError: there are no points, or one of them is not finite.
    """
    difference = _axial_difference(points_m, surface_depth_m)
    slope_x, slope_y = _slopes(points_m[:, 0].astype(np.float64), points_m[:, 1].astype(np.float64), surface_depth_m)
    return summarise_distance(difference / np.sqrt(1.0 + slope_x**2 + slope_y**2))


def summarise_distance(distance_m: NDArray[np.floating]) -> SurfaceDistance:
    """Return offset, spread, largest and RMS value of signed distances [N] in metres, N > 0."""
    distance_um = 1e6 * distance_m.astype(np.float64)
    offset = float(np.median(distance_um))
    return SurfaceDistance(
        offset_um=offset,
        spread_um=float(np.sqrt(np.mean((distance_um - offset) ** 2))),
        max_um=float(np.max(np.abs(distance_um))),
        rms_um=float(np.sqrt(np.mean(distance_um**2))),
    )


def _axial_difference(points_m: NDArray[np.floating], surface_depth_m: SurfaceDepth) -> NDArray[np.float64]:
    if points_m.ndim != 2 or points_m.shape[1] != 3 or len(points_m) == 0:
        raise QueryError(f"surface distance: expected points [N, 3] with N > 0, got an array of {points_m.shape}")
    if not np.isfinite(points_m).all():
        bad = int(np.argmax(~np.isfinite(points_m).all(axis=1)))
        raise QueryError(f"surface distance: expected finite points, got {points_m[bad]} at index {bad}")
    x, y, z = points_m.astype(np.float64).T
    return np.asarray(z - surface_depth_m(x, y), dtype=np.float64)


def _slopes(
    x: NDArray[np.float64], y: NDArray[np.float64], surface_depth_m: SurfaceDepth
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    h = _SLOPE_STEP_M
    slope_x = (surface_depth_m(x + h, y) - surface_depth_m(x - h, y)) / (2 * h)
    slope_y = (surface_depth_m(x, y + h) - surface_depth_m(x, y - h)) / (2 * h)
    return slope_x, slope_y
