"""What the neighbours of a waypoint say about its depth: a plane through them, robustly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_ITERATIONS = 4
# An outlier deviates by more standard deviations of its neighbours than this.
_SIGMAS = 4.5
# Tukey's biweight keeps 95 % efficiency on normal noise with this many standard deviations.
_TUKEY = 4.685
_SCALE_OF_MAD = 1.4826
# Points that are looked at together, which keeps their temporaries below some 20 MB.
_CHUNK = 4096
# Directions in which half of the neighbours is asked where all of them disagree, as on either side of a cliff.
_HALVES = 8


def allowed_deviation(scatter: NDArray[np.float64], least: float, limit: float) -> NDArray[np.float64]:
    """Return how far a point may lie off neighbours that scatter so much [N], all in one unit of length."""
    return np.clip(_SIGMAS * scatter, least, limit)


def deviation_from_neighbours(
    points_m: NDArray[np.float64],
    depth_m: NDArray[np.float64],
    shape_m: NDArray[np.float64],
    count: int,
    floor_m: float,
    least_m: float,
    limit_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance of depths from a plane through their neighbours, and the scatter of the neighbours about it.

    The plane is fitted by iteratively reweighted least squares (Tukey's biweight) to the nearest `count` points, the
    point itself left out. Where that does not fit, the shape of a rougher surface is laid under it, so that a point on
    a crest is no outlier, and the neighbours on one side are asked alone, so that one beside a cliff is held against
    its own side.

    Args:
        points_m: lateral places (x, y) [N, 2].
        depth_m: depths [N]; NaN where there is none, which is then not asked and has no answer.
        shape_m: depths of the rougher surface [N].
        count: neighbours of each point.
        floor_m: scatter below which no neighbour is doubted.
        least_m: deviation that is allowed in any case.
        limit_m: deviation that is never allowed; see `allowed_deviation`.

    Returns:
        Deviation [N], signed, and scatter [N] as a standard deviation; infinite where the depth is not known.
    """
    deviation, scatter = np.full(len(depth_m), np.inf), np.full(len(depth_m), np.inf)
    known = np.flatnonzero(np.isfinite(depth_m))
    count = min(count, len(known) - 1)
    if count < 3:
        deviation[known], scatter[known] = 0.0, 0.0
        return deviation, scatter
    places = points_m[known]
    tree, rough = cKDTree(places), (depth_m - shape_m)[known]
    for start in range(0, len(known), _CHUNK):
        some = slice(start, start + _CHUNK)
        near = tree.query(places[some], k=count + 1)[1][:, 1:]
        away = places[near] - places[some, None]
        rise, other_rise = (values[near] - values[some, None] for values in (depth_m[known], rough))
        found, spread = _held_against(away, rise, other_rise, floor_m, least_m, limit_m)
        deviation[known[some]], scatter[known[some]] = -found, spread
    return deviation, scatter


def share_of_neighbours(points_m: NDArray[np.float64], chosen: NDArray[np.bool_], count: int) -> NDArray[np.float64]:
    """Return the share of chosen ones [N] among the nearest `count` neighbours of each point, itself left out.

    Args:
        points_m: lateral places (x, y) [N, 2].
        chosen: which points are counted [N].
        count: neighbours of each point; all of them if there are fewer.
    """
    count = min(count, len(points_m) - 1)
    if count < 1 or not chosen.any():
        return np.zeros(len(points_m))
    near = cKDTree(points_m).query(points_m, k=count + 1)[1][:, 1:]
    return np.asarray(chosen[near].mean(axis=1))


def _held_against(
    away: NDArray[np.float64],
    rise: NDArray[np.float64],
    other_rise: NDArray[np.float64],
    floor_m: float,
    least_m: float,
    limit_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Height of the neighbours' plane at points [N] and their scatter about it [N].

    Args:
        away: from each point to its neighbours [N, K, 2].
        rise: depths of the neighbours less its own [N, K].
        other_rise: the same with the rougher surface taken off.
        floor_m: see `deviation_from_neighbours`, as for the rest.
        least_m, limit_m: likewise.
    """
    found, spread = _plane_at_centre(away, rise, np.ones(rise.shape), floor_m)
    doubted = np.flatnonzero((np.abs(found) > allowed_deviation(spread, least_m, limit_m)) | (spread > limit_m / 2))
    for side in [None, *range(_HALVES)] if len(doubted) else []:
        ask, differences, asked = doubted, other_rise[doubted], np.ones((len(doubted), rise.shape[1]))
        if side is not None:
            angle = 2 * np.pi * side / _HALVES
            there = away[doubted] @ np.array([np.cos(angle), np.sin(angle)]) >= -1e-9
            enough = there.sum(axis=1) >= 4
            ask, differences, asked = doubted[enough], rise[doubted[enough]], there[enough].astype(float)
        one, its_spread = _plane_at_centre(away[ask], differences, asked, floor_m)
        better = (its_spread < spread[ask]) & (np.abs(one) <= allowed_deviation(its_spread, least_m, limit_m))
        found[ask[better]], spread[ask[better]] = one[better], its_spread[better]
    return found, spread


def _plane_at_centre(
    away: NDArray[np.float64],
    difference: NDArray[np.float64],
    ask: NDArray[np.float64],
    floor: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit planes to neighbours `away` [N, K, 2] with relative depths [N, K]; height at the centre and scatter [N]."""
    scale = np.sqrt(np.mean(away**2, axis=(1, 2), keepdims=True)) + 1e-12
    basis = np.concatenate([np.ones((*away.shape[:2], 1)), away / scale], axis=-1)
    weight = ask.copy()
    # Points on one line leave the slope across it open; zero then.
    ridge = 1e-6 * np.eye(basis.shape[-1])
    ridge[0, 0] = 1e-12
    everyone, asked = bool((ask > 0).all()), np.where(ask > 0, 1.0, np.nan)
    for _ in range(_ITERATIONS):
        weighted = basis * weight[..., None]
        across = weighted.transpose(0, 2, 1)
        plane = np.linalg.solve(across @ basis + ridge, across @ difference[..., None])
        residual = difference - (basis @ plane)[..., 0]
        size = np.abs(residual)
        spread = _SCALE_OF_MAD * (np.median(size, axis=1) if everyone else np.nanmedian(size * asked, axis=1))
        reach = _TUKEY * np.maximum(spread, floor)
        weight = ask * np.maximum(1.0 - (residual / reach[:, None]) ** 2, 0.0) ** 2
    return plane[:, 0, 0], spread
