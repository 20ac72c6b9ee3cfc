"""The surface along a straight line and under a point, as the query node answers it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.planning import (
    RasterPattern,
    SurfaceSearch,
    SurfaceSearchConfig,
    WaypointConfig,
    find_surface,
    inward_normals,
    waypoint_poses,
)


def sample_line(
    start_m: NDArray[np.float64], goal_m: NDArray[np.float64], spacing_m: float, most: int
) -> NDArray[np.float64]:
    """Return points [N, 2] every `spacing_m` from start on, and the goal.

    Raises:
        QueryError: the spacing is not a positive number, or there would be more than `most` points.
    """
    length = float(np.linalg.norm(goal_m - start_m))
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise QueryError(f"expected a sample spacing (tolerance) of 0 or more metres, got {spacing_m}")
    if length / spacing_m > most - 1:
        raise QueryError(
            f"expected at most {most:,} samples (parameter limits.line_samples), got {length:g} m every {spacing_m:g} m"
        )
    if length == 0.0:
        return start_m[None]
    along = np.append(np.arange(0.0, length - 1e-6 * spacing_m, spacing_m), length)
    return start_m + (along / length)[:, None] * (goal_m - start_m)


def surface_poses(
    field: Field, points_m: NDArray[np.float64], found: SurfaceSearch, normals: WaypointConfig
) -> NDArray[np.float64]:
    """Return poses [M, 4, 4] on the surface that was found under points [N, 2], z along the inward normal.

    Points without a trustworthy surface are left out, so M may be less than N.
    """
    kept = ~found.given_up
    surface = np.column_stack([points_m, found.depth_m])[kept]
    return waypoint_poses(surface, inward_normals(field, surface, normals.normal_radius_voxels), 0.0)


def surface_under(
    field: Field, points_m: NDArray[np.float64], tau: float | None, search: SurfaceSearchConfig
) -> SurfaceSearch:
    """Return the surface under points [N, 2] of one line.

    Raises:
        PlanError: a point lies outside the scan, or there is no surface at all.
    """
    return find_surface(field, RasterPattern(points_m, np.zeros(len(points_m), dtype=np.int32)), tau, search)
