"""Raster patterns in the lateral plane: where the laser shall go, before any depth is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.errors import PlanError
from octn_ros.settings import check_settings, setting

MAX_WAYPOINTS = 1_000_000
# Below a nanometre a rectangle is empty and a difference is rounding.
_NOTHING_M = 1e-9


@dataclass(frozen=True)
class RasterConfig:
    """Density of a raster.

    Raises:
        ConfigurationError: a spacing is not a positive, finite number of metres.
    """

    line_spacing_m: float = setting(
        50e-6, "largest distance between neighbouring raster lines", unit="m", low=1e-7, high=0.1
    )
    point_spacing_m: float = setting(
        50e-6, "largest distance between neighbouring waypoints of a line", unit="m", low=1e-7, high=0.1
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, eq=False)
class RasterPattern:
    """Planned lateral places in the order of travel, the paper's G; read-only.

    Attributes:
        points_m: (x, y) = (lateral, bscan) [N, 2] in the OCT frame, in metres.
        segment: number of the raster line that each point belongs to [N], int32, from 0.
    """

    points_m: NDArray[np.float64]
    segment: NDArray[np.int32]


def rectangle_corners(corner_m: ArrayLike, opposite_corner_m: ArrayLike, angle_rad: float) -> NDArray[np.float64]:
    """Return the four corners [4, 2] in order around a rectangle, the given ones at 0 and 2.

    Args:
        corner_m: one corner (x, y) in the OCT frame, in metres.
        opposite_corner_m: the corner across the diagonal.
        angle_rad: angle of the rectangle's first side against the lateral axis, towards the bscan axis.

    Raises:
        PlanError: a number is not finite, or a side of the rectangle has no length.
    """
    corner, opposite = np.asarray(corner_m, dtype=np.float64), np.asarray(opposite_corner_m, dtype=np.float64)
    if corner.shape != (2,) or opposite.shape != (2,):
        raise PlanError(f"expected two corners (x, y), got arrays of {corner.shape} and {opposite.shape}")
    if not (np.isfinite(corner).all() and np.isfinite(opposite).all() and math.isfinite(angle_rad)):
        raise PlanError(
            "expected a raster rectangle of finite numbers, "
            f"got corners {corner.tolist()} m and {opposite.tolist()} m, angle {angle_rad} rad"
        )
    first = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    second = np.array([-first[1], first[0]])
    diagonal = opposite - corner
    along, across = float(diagonal @ first), float(diagonal @ second)
    if min(abs(along), abs(across)) < _NOTHING_M:
        raise PlanError(
            f"expected a raster rectangle with two sides, got {abs(along) * 1e3:.6g} x {abs(across) * 1e3:.6g} mm "
            f"between ({corner[0] * 1e3:.3f}, {corner[1] * 1e3:.3f}) mm and "
            f"({opposite[0] * 1e3:.3f}, {opposite[1] * 1e3:.3f}) mm at {math.degrees(angle_rad):.3g} degrees"
        )
    return np.stack([corner, corner + along * first, opposite, corner + across * second])


def rectangle_raster(
    corner_m: ArrayLike,
    opposite_corner_m: ArrayLike,
    angle_rad: float = 0.0,
    config: RasterConfig | None = None,
) -> RasterPattern:
    """Fill a rectangle with lines along its first side, there and back again (zigzag).

    Lines and waypoints are evenly spread, no further apart than the spacings, with the first and last on the edges.

    Args:
        corner_m: where the path starts, (x, y) in the OCT frame, in metres.
        opposite_corner_m: the corner across the diagonal.
        angle_rad: angle of the first side against the lateral axis, towards the bscan axis.
        config: spacings; the defaults if left out.

    Raises:
        PlanError: the rectangle is empty or not finite, or the raster would have more than a million waypoints
            (nothing is allocated for it).
    """
    config = config or RasterConfig()
    corners = rectangle_corners(corner_m, opposite_corner_m, angle_rad)
    side, other_side = corners[1] - corners[0], corners[3] - corners[0]
    lines, points = _count(other_side, config.line_spacing_m), _count(side, config.point_spacing_m)
    if lines * points > MAX_WAYPOINTS:
        raise PlanError(
            f"expected at most {MAX_WAYPOINTS:,} waypoints, got {lines:.4g} lines of {points:.4g}: "
            f"{np.hypot(*other_side) * 1e3:.3f} mm at a line spacing of {config.line_spacing_m * 1e6:g} um, "
            f"{np.hypot(*side) * 1e3:.3f} mm at a point spacing of {config.point_spacing_m * 1e6:g} um"
        )
    share = np.broadcast_to(np.linspace(0.0, 1.0, int(points)), (int(lines), int(points))).copy()
    share[1::2] = share[1::2, ::-1]
    offset = np.linspace(0.0, 1.0, int(lines))[:, None, None] * other_side
    grid = corners[0] + offset + share[..., None] * side
    segment = np.repeat(np.arange(int(lines), dtype=np.int32), int(points))
    return RasterPattern(points_m=grid.reshape(-1, 2), segment=segment)


def _count(side: NDArray[np.float64], spacing_m: float) -> float:
    """Number of evenly spaced places on a side, ends included; a float, since it may be too large to count."""
    intervals = float(np.hypot(*side)) / spacing_m
    # A side of 3 mm is 60.0000000001 intervals of 50 um in binary; that is 60.
    return max(float(np.ceil(intervals * (1.0 - 1e-9))), 1.0) + 1.0
