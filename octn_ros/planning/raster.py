"""Raster patterns in the lateral plane: where the laser shall go."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.errors import PlanError
from octn_ros.planning.region import Region, rectangle_region
from octn_ros.planning.scanline import EMPTY_M
from octn_ros.settings import check_settings, setting

MAX_WAYPOINTS = 1_000_000
# Steps along a line in which its length on the surface is added up, per waypoint.
_ARC_STEPS = 4
# Waypoints that a line may get over its length by the spacing, at most, so that no step is longer.
_SPARE = 8

# Depth z [N] in metres under lateral places (x, y) [N, 2] of the OCT frame.
DepthAt = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class RasterConfig:
    """Density and order of a raster.

    Raises:
        ConfigurationError: a spacing is not a positive, finite number of metres, or a length is negative.
    """

    line_spacing_m: float = setting(
        50e-6, "largest lateral distance between neighbouring raster lines", unit="m", low=1e-7, high=0.1
    )
    point_spacing_m: float = setting(
        50e-6, "largest distance between neighbouring waypoints of a line", unit="m", low=1e-7, high=0.1
    )
    point_spacing_along: str = setting(
        "surface", "what the waypoint distance is measured along: the surface, as a coarse first pass finds it, or the "
        "lateral plane", choices=("surface", "lateral"),
    )  # fmt: skip
    order: str = setting(
        "zigzag", "lines there and back again, or all in the direction of the first", choices=("zigzag", "one-way")
    )
    lead_in_m: float = setting(
        0.0, "stretch before each line with the laser off, 0 for none", unit="m", low=0.0, high=0.01
    )
    lead_out_m: float = setting(
        0.0, "stretch after each line with the laser off, 0 for none", unit="m", low=0.0, high=0.01
    )
    margin_m: float = setting(
        0.0, "distance kept from the region's border, such as half a spot", unit="m", low=0.0, high=0.01
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, eq=False)
class RasterPattern:
    """Planned lateral places in the order of travel, the paper's G; read-only.

    Attributes:
        points_m: (x, y) = (lateral, bscan) [N, 2] in the OCT frame, in metres.
        segment: number of the raster line, or of the piece of it in a concave region, that each point belongs to [N],
            int32, from 0.
    """

    points_m: NDArray[np.float64]
    segment: NDArray[np.int32]


def rectangle_raster(
    corner_m: ArrayLike,
    opposite_corner_m: ArrayLike,
    angle_rad: float = 0.0,
    config: RasterConfig | None = None,
) -> RasterPattern:
    """Fill a rectangle with lines along its first side; see `raster_pattern`, whose waypoints are spread laterally.

    Args:
        corner_m: where the path starts, (x, y) in the OCT frame, in metres.
        opposite_corner_m: the corner across the diagonal.
        angle_rad: angle of the first side against the lateral axis, towards the bscan axis.
        config: spacings; the defaults if left out.

    Raises:
        PlanError: the rectangle is empty or not finite, or the raster would have more than a million waypoints
            (nothing is allocated for it).
    """
    return raster_pattern(rectangle_region(corner_m, opposite_corner_m, angle_rad), config)


def raster_pattern(region: Region, config: RasterConfig | None = None, depth_m: DepthAt | None = None) -> RasterPattern:
    """Fill a region with parallel lines, clipped to it.

    Lines are evenly spread from border to border, no further apart than the line spacing. Waypoints are evenly spread
    along each line, no further apart than the point spacing, with the first and last on the border.

    Args:
        region: what is filled; its margin is that of `config`.
        config: spacings and order; the defaults if left out.
        depth_m: the surface along which waypoints are spread; laterally if left out.

    Raises:
        PlanError: the margin leaves nothing of the region, or the raster would have more than a million waypoints.
    """
    config = config or RasterConfig()
    region = region.inset(config.margin_m)
    runs: list[NDArray[np.float64]] = []
    total = 0
    for v, u0, u1, back in _stretches(region, config):
        run = _run(region, v, u0, u1, config.point_spacing_m, depth_m)
        runs.append(run[::-1] if back else run)
        total += len(run)
        if total > MAX_WAYPOINTS:
            raise PlanError(
                f"expected at most {MAX_WAYPOINTS:,} waypoints, got more on the surface at a point spacing of "
                f"{config.point_spacing_m * 1e6:g} um; spread them wider, or along the lateral plane"
            )
    segment = np.repeat(np.arange(len(runs), dtype=np.int32), [len(run) for run in runs])
    return RasterPattern(points_m=np.concatenate(runs), segment=segment)


def count_waypoints(region: Region, config: RasterConfig | None = None) -> int:
    """Return how many waypoints `raster_pattern` spreads laterally over a region, without spreading them.

    Args:
        region: likewise.
        config: likewise.

    Raises:
        PlanError: likewise.
    """
    config = config or RasterConfig()
    region = region.inset(config.margin_m)
    stretches = _stretches(region, config)
    return sum(1 if _is_corner(u0, u1) else int(_count(u1 - u0, config.point_spacing_m)) for _, u0, u1, _ in stretches)


def _stretches(region: Region, config: RasterConfig) -> Iterator[tuple[float, float, float, bool]]:
    """Yield (v, u0, u1) of each stretch of a line in the order of travel, and whether it is travelled from u1 to u0."""
    first, last = region.line_range()
    lines = _count(last - first, config.line_spacing_m)
    width = float(np.ptp(region.to_uv(region.vertices_m)[:, 0]))
    points = _count(max(width - 2 * config.margin_m, 0.0), config.point_spacing_m)
    if lines * points > MAX_WAYPOINTS:
        raise PlanError(
            f"expected at most {MAX_WAYPOINTS:,} waypoints, got {lines:.4g} lines of {points:.4g}: "
            f"{(last - first) * 1e3:.3f} mm at a line spacing of {config.line_spacing_m * 1e6:g} um, "
            f"{width * 1e3:.3f} mm at a point spacing of {config.point_spacing_m * 1e6:g} um"
        )
    offsets = np.linspace(first, last, int(lines))
    for number, (v, spans) in enumerate(zip(offsets.tolist(), region.line_spans(offsets), strict=True)):
        back = config.order == "zigzag" and number % 2 == 1
        for u0, u1 in (spans[::-1] if back else spans).tolist():
            yield v, u0, u1, back


def _is_corner(u0: float, u1: float) -> bool:
    """Whether a line meets the region in a mere corner: one waypoint, not to fire twice."""
    return u1 - u0 < 0.5 * EMPTY_M


def _run(
    region: Region, v: float, u0: float, u1: float, spacing: float, depth_m: DepthAt | None
) -> NDArray[np.float64]:
    """Spread waypoints over one stretch of a line, ends included."""
    if _is_corner(u0, u1):
        return region.to_xy(np.array([0.5 * (u0 + u1)]), np.array([v]))
    if depth_m is None:
        u = np.linspace(u0, u1, int(_count(u1 - u0, spacing)))
        return region.to_xy(u, np.full_like(u, v))
    fine = np.linspace(u0, u1, _ARC_STEPS * int(_count(u1 - u0, spacing)) + 1)
    depth = depth_m(region.to_xy(fine, np.full_like(fine, v)))
    length = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(fine), np.diff(depth)))))
    count = int(_count(length[-1], spacing))
    # Between the samples the surface bends, so that a step may come out a little longer than its share of the length.
    for waypoints in range(count, count + _SPARE):
        u = np.interp(np.linspace(0.0, length[-1], waypoints), length, fine)
        places = region.to_xy(u, np.full_like(u, v))
        if np.hypot(np.diff(u), np.diff(depth_m(places))).max() <= spacing * (1.0 + 1e-9):
            break
    return places


def _count(length_m: float, spacing_m: float) -> float:
    """Number of evenly spaced places on a length, ends included; a float, since it may be too large to count."""
    # A side of 3 mm is 60.0000000001 intervals of 50 um in binary; that is 60.
    return max(float(np.ceil(length_m / spacing_m * (1.0 - 1e-9))), 1.0) + 1.0
