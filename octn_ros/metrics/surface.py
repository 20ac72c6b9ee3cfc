"""How far points lie from a surface that is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from octn_ros.errors import QueryError

# Depth z [N] in metres of the true surface at x [N], y [N], all in the OCT frame.
SurfaceDepth = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
# Half a nanometre would drown in rounding, half a voxel would round off a wave; a micrometre does neither.
_SLOPE_STEP_M = 1e-6
# The true surface is sampled this finely to find the nearest point of it, more coarsely where that would be millions.
_SAMPLE_STEP_M = 4e-6
_MOST_SAMPLES = 2_000_000
# Points whose nearest surface lies further away than this sideways are told the distance straight down instead.
_LARGEST_MARGIN_M = 200e-6


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


def depth_rms_um(points_m: NDArray[np.floating], surface_depth_m: SurfaceDepth) -> float:
    """Root mean square difference in axial depth between points and the true surface, in micrometres.

    Args:
        points_m: points [N, (x, y, z)] in the OCT frame.
        surface_depth_m: depth of the true surface as a function of x [N] and y [N], vectorised.

    Raises:
        QueryError: there are no points, or one of them is not finite.
    """
    return float(np.sqrt(np.mean(_axial_difference(points_m, surface_depth_m) ** 2)) * 1e6)


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


def nearest_distance_m(points_m: NDArray[np.floating], surface_depth_m: SurfaceDepth) -> NDArray[np.float64]:
    """Signed distance of points to the nearest point of the true surface, wherever it lies; positive is deeper.

    The surface is sampled every 4 um (more coarsely over more than 5 x 5 mm) around the points, the walls of steps
    included, and searched by a KD-tree; the tangent plane at the nearest sample then gives the distance, so that on
    smooth surfaces the error is far below the sampling. Where there is no tangent plane (edges and walls of steps) it
    is the distance to the sample itself, too large by at most half the sampling. Never larger than the axial
    distance.

    Args:
        points_m: points [N, (x, y, z)] in the OCT frame.
        surface_depth_m: depth of the true surface as a function of x [N] and y [N], vectorised.

    Returns:
        Distances [N] in metres.

    Raises:
        QueryError: there are no points, or one of them is not finite.
    """
    difference = _axial_difference(points_m, surface_depth_m)
    points = points_m.astype(np.float64)
    margin = min(float(np.abs(difference).max()), _LARGEST_MARGIN_M) + _SAMPLE_STEP_M
    samples, step = _sampled_surface(
        points[:, :2].min(axis=0) - margin, points[:, :2].max(axis=0) + margin, surface_depth_m
    )
    distance, index = KDTree(samples).query(points)
    nearest = samples[index]
    slope_x, slope_y = _slopes(nearest[:, 0], nearest[:, 1], surface_depth_m)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    off_plane = np.abs(np.einsum("ij,ij->i", points - nearest, normal))
    # On a smooth piece the foot of the perpendicular lies within a sample's cell; on a rim or a wall it does not.
    along = np.sqrt(np.maximum(distance**2 - off_plane**2, 0.0))
    smooth = along <= step / np.maximum(normal[:, 2], 0.1)
    nearest_m = np.minimum(np.where(smooth, off_plane, distance), np.abs(difference))
    return np.copysign(nearest_m, difference)


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


def _sampled_surface(
    low: NDArray[np.float64], high: NDArray[np.float64], surface_depth_m: SurfaceDepth
) -> tuple[NDArray[np.float64], float]:
    """Sample the surface over a lateral rectangle, walls included: points [M, 3] and the lateral step in metres."""
    width, length = high - low
    step = max(_SAMPLE_STEP_M, float(np.sqrt(width * length / _MOST_SAMPLES)))
    x, y = (low[axis] + step * np.arange(int(np.ceil((high - low)[axis] / step)) + 1) for axis in (0, 1))
    grid_x, grid_y = np.meshgrid(x, y)
    depth = surface_depth_m(grid_x.ravel(), grid_y.ravel()).reshape(grid_x.shape)
    surface = np.stack([grid_x, grid_y, depth], axis=-1)
    walls = [
        _filled(first.reshape(-1, 3), second.reshape(-1, 3), step)
        for first, second in ((surface[:, :-1], surface[:, 1:]), (surface[:-1], surface[1:]))
    ]
    return np.concatenate([surface.reshape(-1, 3), *walls]), step


def _filled(first: NDArray[np.float64], second: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Points between neighbouring samples whose depths differ by far more than their lateral distance."""
    gap = np.abs(second[:, 2] - first[:, 2])
    steep = gap > 4.0 * step
    first, second, parts = first[steep], second[steep], np.ceil(gap[steep] / step).astype(int)
    number = np.concatenate([np.arange(1, count) for count in parts]) if len(parts) else np.zeros(0)
    share = (number / np.repeat(parts, parts - 1))[:, None]
    between: NDArray[np.float64] = np.repeat(first, parts - 1, axis=0) * (1.0 - share)
    return between + np.repeat(second, parts - 1, axis=0) * share
