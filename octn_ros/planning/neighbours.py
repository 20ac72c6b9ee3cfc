"""What the neighbours of a waypoint say about its depth: a plane through them, robustly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_ITERATIONS = 4
# Tukey's biweight keeps 95 % efficiency on normal noise with this many standard deviations.
_TUKEY = 4.685
_SCALE_OF_MAD = 1.4826
# Directions in which half of the neighbours is asked where all of them disagree, as on either side of a cliff.
_HALVES = 8


def deviation_from_neighbours(
    points_m: NDArray[np.float64], depth_m: NDArray[np.float64], count: int, floor_m: float, limit_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance of depths from a plane through their neighbours, and the scatter of the neighbours about it.

    The plane is fitted by iteratively reweighted least squares (Tukey's biweight) to the nearest `count` points, the
    point itself left out. Where the deviation exceeds `limit_m`, the neighbours on one side are asked alone, so that a
    point beside a cliff is held against its own side.

    Args:
        points_m: lateral places (x, y) [N, 2].
        depth_m: depths [N]; NaN where there is none, which is then not asked and has no answer.
        count: neighbours of each point.
        floor_m: scatter below which no neighbour is doubted.
        limit_m: deviation beyond which one side is asked alone.

    Returns:
        Deviation [N], signed, and scatter [N] as a standard deviation; infinite where there are too few neighbours.
    """
    deviation, scatter = np.full(len(depth_m), np.inf), np.full(len(depth_m), np.inf)
    known = np.flatnonzero(np.isfinite(depth_m))
    count = min(count, len(known) - 1)
    if count < 3:
        deviation[known], scatter[known] = 0.0, 0.0
        return deviation, scatter
    places, depths = points_m[known], depth_m[known]
    _, near = cKDTree(places).query(places, k=count + 1)
    near = near[:, 1:]
    away = places[near] - places[:, None]
    difference = depths[near] - depths[:, None]
    found, spread = _plane_at_centre(away, difference, np.ones(difference.shape), floor_m)
    doubted = np.flatnonzero(np.abs(found) > limit_m)
    for half in range(_HALVES if len(doubted) else 0):
        angle = 2 * np.pi * half / _HALVES
        side = away[doubted] @ np.array([np.cos(angle), np.sin(angle)]) >= -1e-9
        one, its_spread = _plane_at_centre(away[doubted], difference[doubted], side.astype(float), floor_m)
        better = (np.abs(one) < np.abs(found[doubted])) & (its_spread < limit_m) & (side.sum(axis=1) >= 4)
        found[doubted[better]], spread[doubted[better]] = one[better], its_spread[better]
    deviation[known], scatter[known] = -found, spread
    return deviation, scatter


def _plane_at_centre(
    away: NDArray[np.float64], difference: NDArray[np.float64], ask: NDArray[np.float64], floor: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit planes to neighbours `away` [N, K, 2] with relative depths [N, K]; height at the centre and scatter [N]."""
    scale = np.sqrt(np.mean(away**2, axis=(1, 2), keepdims=True)) + 1e-12
    basis = np.concatenate([np.ones((*away.shape[:2], 1)), away / scale], axis=-1)
    weight = ask.copy()
    ridge = 1e-6 * np.diag([0.0, 1.0, 1.0]) + 1e-12 * np.eye(3)
    asked = np.where(ask > 0, 1.0, np.nan)
    for _ in range(_ITERATIONS):
        weighted = basis * weight[..., None]
        normal = np.einsum("nki,nkj->nij", weighted, basis) + ridge
        plane = np.linalg.solve(normal, np.einsum("nki,nk->ni", weighted, difference)[..., None])[..., 0]
        residual = difference - np.einsum("nki,ni->nk", basis, plane)
        spread = _SCALE_OF_MAD * np.nanmedian(np.abs(residual) * asked, axis=1)
        reach = _TUKEY * np.maximum(spread, floor)
        weight = ask * np.maximum(1.0 - (residual / reach[:, None]) ** 2, 0.0) ** 2
    return plane[:, 0], spread
