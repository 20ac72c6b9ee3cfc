"""The paper's baseline: the surface of the voxels, and the nearest of its points under each raster point."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from octn_ros.errors import PlanError
from octn_ros.planning.give_up import GiveUp
from octn_ros.planning.raster import RasterPattern
from octn_ros.planning.surface_search import SurfaceSearch, check_inside
from octn_ros.query import native_surface
from octn_ros.volume import Volume, gaussian_filter_of_size, median_filter

FilterName = Literal["none", "gaussian", "median"]


@dataclass(frozen=True, eq=False)
class NativeSurface:
    """The surface of a volume's voxels with a tree to look its points up; read-only.

    Attributes:
        points_m: points (x, y, z) [S, 3] in the OCT frame, one per A-scan.
        tree: KD-tree over their lateral places (x, y).
        volume: the volume it was made from, filtered.
        tau: median intensity of the surface points.
        filter: what was laid over the volume before.
        seconds: time of the stages "filter", "surface" and "tree".
    """

    points_m: NDArray[np.float64]
    tree: cKDTree
    volume: Volume
    tau: float
    filter: FilterName
    seconds: dict[str, float]


def baseline_surface(volume: Volume, filter: FilterName = "none") -> NativeSurface:
    """Find the surface of a whole volume as the paper's baseline does, and build the tree over it.

    Args:
        volume: the measured C-scan.
        filter: "none" as in the paper, or its Gaussian or median filter of size 3 first.

    Raises:
        PlanError: there is no such filter.
    """
    filters = {"none": lambda v: v, "gaussian": gaussian_filter_of_size, "median": median_filter}
    if filter not in filters:
        raise PlanError(f"baseline: expected the filter {', '.join(filters)}, got {filter!r}")
    began = time.perf_counter()
    filtered = filters[filter](volume)
    filter_done = time.perf_counter()
    points = native_surface(filtered)
    surface_done = time.perf_counter()
    tree = cKDTree(points[:, :2])
    tree_done = time.perf_counter()
    seconds = {
        "filter": filter_done - began,
        "surface": surface_done - filter_done,
        "tree": tree_done - surface_done,
    }
    return NativeSurface(points, tree, filtered, float(np.median(_intensity(filtered, points))), filter, seconds)


def knn_baseline(
    source: Volume | NativeSurface, pattern: RasterPattern, filter: FilterName = "none", *, k: int = 1
) -> SurfaceSearch:
    """Give each raster point the depth of the nearest surface point in the lateral plane (the paper's baseline).

    Nothing is given up, as in the paper. Thread-safe; the stages are timed one by one, tau (which the method itself
    does not need) in none of them.

    Args:
        source: the measured C-scan, or its surface and tree if they are at hand.
        pattern: raster points in the OCT frame.
        filter: of the volume, see `baseline_surface`; of a surface at hand it is known.
        k: number of nearest surface points whose depths are averaged; the paper names none, 1 is its plainest reading.

    Returns:
        The surface; intensities and tau are those of the (filtered) voxels, interpolated trilinearly. `seconds` has
        the stages "filter", "surface" and "tree", 0 if they were at hand, and "query".

    Raises:
        PlanError: a point lies outside the scan, k is not positive, or there is no such filter.
    """
    if k < 1:
        raise PlanError(f"baseline: expected k of at least 1, got {k}")
    at_hand = isinstance(source, NativeSurface)
    volume = source.volume if isinstance(source, NativeSurface) else source
    points = np.asarray(pattern.points_m, dtype=np.float64)
    check_inside(volume.geometry, points)
    surface = source if isinstance(source, NativeSurface) else baseline_surface(source, filter)
    began = time.perf_counter()
    _, nearest = surface.tree.query(points, k=k)
    depth_m = surface.points_m[nearest, 2]
    if k > 1:
        depth_m = depth_m.mean(axis=1)
    asked = time.perf_counter() - began
    intensity = _intensity(surface.volume, np.column_stack([points, depth_m]))
    words = "" if surface.filter == "none" else f" after the {surface.filter} filter of size 3"
    return SurfaceSearch(
        depth_m=depth_m,
        intensity=intensity,
        residual=intensity - surface.tau,
        confidence=np.ones(len(points)),
        given_up=np.zeros(len(points), dtype=np.bool_),
        reason=np.full(len(points), GiveUp.KEPT, dtype=np.int8),
        tau=np.full(len(points), surface.tau),
        coarse_depth_m=depth_m,
        offset_correction_m=0.0,
        method=f"kNN baseline: largest |first difference| of each A-scan{words}, nearest {k} in the lateral plane",
        seconds={name: 0.0 if at_hand else value for name, value in surface.seconds.items()} | {"query": asked},
    )


def _intensity(volume: Volume, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = volume.intensity_range
    index = volume.geometry.metric_to_voxel(points_m).T
    values = ndimage.map_coordinates(volume.array, index, output=np.float64, order=1, mode="nearest")
    return np.clip((values - low) / (high - low), 0.0, 1.0)
