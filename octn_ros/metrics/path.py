"""How well a path lies on the surface, and how smoothly it runs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import PlanError


def hit_rate(
    intensity: NDArray[np.floating], tau: float, given_up: NDArray[np.bool_], tolerance: float = 0.05
) -> float:
    """Share of the requested waypoints whose intensity lies within `tolerance` of tau; given-up ones are misses.

    Args:
        intensity: field intensity at each requested waypoint [N]; not read where given up, so NaN is allowed there.
        tau: target intensity of the surface (eq. 7), greater than 0.
        given_up: waypoints that were left out of the path [N].
        tolerance: largest |intensity - tau| / tau of a hit, 5 % in the paper.

    Returns:
        Hits divided by N, in [0, 1].

    Raises:
        PlanError: there are no waypoints, the shapes differ, or tau is not a positive number.
    """
    if intensity.ndim != 1 or intensity.shape != given_up.shape or intensity.size == 0:
        raise PlanError(f"hit_rate: expected two filled arrays [N], got {intensity.shape} and {given_up.shape}")
    if not (np.isfinite(tau) and tau > 0):
        raise PlanError(f"hit_rate: expected a positive tau, got {tau}")
    hits = (np.abs(intensity - tau) <= tolerance * tau) & ~given_up
    return float(np.mean(hits))


def smoothness_energy_mm2(depth_m: NDArray[np.floating], segment: NDArray[Any]) -> float:
    """Sum of squared second differences of depth along the path in mm^2 (eq. 13).

    The mask v_i of the paper is 1 where a point and both its neighbours belong to one segment, so that turns and
    gaps between segments do not count.

    Args:
        depth_m: axial depth of each waypoint [N] in metres, in the order of travel.
        segment: number of the segment that each waypoint belongs to [N].

    Raises:
        PlanError: the shapes differ.
    """
    if depth_m.ndim != 1 or depth_m.shape != segment.shape:
        raise PlanError(f"smoothness: expected two arrays [N], got {depth_m.shape} and {segment.shape}")
    depth_mm = depth_m.astype(np.float64) * 1e3
    second = depth_mm[2:] - 2.0 * depth_mm[1:-1] + depth_mm[:-2]
    inside = (segment[2:] == segment[1:-1]) & (segment[1:-1] == segment[:-2])
    return float(np.sum(second[inside] ** 2))
