"""How far two surfaces, given as points, lie apart (eqs. 4 and 5)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from octn_ros.errors import QueryError

# M of the paper: more points than this are thinned out before they are compared.
MAX_POINTS = 100_000


class CloudDistance(NamedTuple):
    """Distances between two point clouds, both in metres.

    Attributes:
        chamfer_m: half the sum of the two mean nearest-neighbour distances (eq. 4).
        hausdorff_m: the largest nearest-neighbour distance of either (eq. 5).
    """

    chamfer_m: float
    hausdorff_m: float


def cloud_distance(
    first_m: NDArray[np.floating], second_m: NDArray[np.floating], max_points: int = MAX_POINTS, seed: int = 0
) -> CloudDistance:
    """Chamfer and Hausdorff distance of two point clouds, by scipy's KD-tree; symmetric, thread-safe.

    Clouds of more than `max_points` are thinned to that many, drawn uniformly without replacement by the seed, as the
    paper does; that raises the Chamfer distance of surfaces that agree, by up to the gaps it makes.

    Args:
        first_m: points (x, y, z) [N, 3] in metres.
        second_m: points [M, 3] in the same frame.
        max_points: largest number of points of each cloud that are compared.
        seed: of the draw.

    Raises:
        QueryError: a cloud is empty, not [N, 3] or not finite, or `max_points` is below 1.
    """
    if max_points < 1:
        raise QueryError(f"point clouds: expected to keep at least 1 point, got max_points {max_points}")
    first, second = _thinned(first_m, max_points, seed), _thinned(second_m, max_points, seed)
    there, _ = KDTree(second).query(first)
    back, _ = KDTree(first).query(second)
    return CloudDistance(
        chamfer_m=0.5 * float(np.mean(there)) + 0.5 * float(np.mean(back)),
        hausdorff_m=float(max(there.max(), back.max())),
    )


def chamfer_m(
    first_m: NDArray[np.floating], second_m: NDArray[np.floating], max_points: int = MAX_POINTS, seed: int = 0
) -> float:
    """Chamfer distance in metres with the paper's factors of 1/2N (eq. 4); see `cloud_distance`."""
    return cloud_distance(first_m, second_m, max_points, seed).chamfer_m


def hausdorff_m(
    first_m: NDArray[np.floating], second_m: NDArray[np.floating], max_points: int = MAX_POINTS, seed: int = 0
) -> float:
    """Hausdorff distance in metres (eq. 5); see `cloud_distance`."""
    return cloud_distance(first_m, second_m, max_points, seed).hausdorff_m


def _thinned(points_m: NDArray[np.floating], most: int, seed: int) -> NDArray[np.float64]:
    points = np.asarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise QueryError(f"point clouds: expected points [N, 3] with N > 0, got an array of {points.shape}")
    if not np.isfinite(points).all():
        bad = int(np.argmax(~np.isfinite(points).all(axis=1)))
        raise QueryError(f"point clouds: expected finite points, got {points[bad]} at index {bad}; leave it out")
    if len(points) <= most:
        return points
    kept: NDArray[np.float64] = points[np.random.default_rng(seed).choice(len(points), most, replace=False)]
    return kept
