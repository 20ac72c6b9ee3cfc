"""The paper's baseline: the surface of the voxels, and the nearest of its points under each raster point."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from octn_ros.planning.raster import RasterPattern
from octn_ros.planning.search_result import SurfaceSearch
from octn_ros.planning.surface_search import check_inside
from octn_ros.query import native_surface
from octn_ros.volume import Volume


@dataclass(frozen=True, eq=False)
class NativeSurface:
    """The surface of a volume's voxels with a tree to look its points up; read-only.

    Attributes:
        points_m: points (x, y, z) [S, 3] in the OCT frame, one per A-scan.
        tree: KD-tree over their lateral places (x, y).
        volume: the volume it was made from.
        tau: median intensity of the surface points.
        seconds: time of the stages "surface" and "tree".
    """

    points_m: NDArray[np.float64]
    tree: cKDTree
    volume: Volume
    tau: float
    seconds: dict[str, float]


def baseline_surface(volume: Volume) -> NativeSurface:
    """Find the surface of a whole volume as the paper's baseline does, and build the tree over it.

    Args:
        volume: the C-scan, as measured or filtered.
    """
    began = time.perf_counter()
    points = native_surface(volume)
    surface_done = time.perf_counter()
    tree = cKDTree(points[:, :2])
    tree_done = time.perf_counter()
    seconds = {"surface": surface_done - began, "tree": tree_done - surface_done}
    return NativeSurface(points, tree, volume, float(np.median(_intensity(volume, points))), seconds)


def knn_baseline(source: Volume | NativeSurface, pattern: RasterPattern) -> SurfaceSearch:
    """Give each raster point the depth of the nearest surface point in the lateral plane (the paper's baseline).

    The paper names no number of neighbours; one is its plainest reading. Nothing is given up, as in the paper.
    Thread-safe; the stages are timed one by one, tau (which the method itself does not need) in none of them.

    Args:
        source: the C-scan, as measured or filtered, or its surface and tree if they are at hand.
        pattern: raster points in the OCT frame.

    Returns:
        The surface; intensities and tau are those of the voxels, interpolated trilinearly. `seconds` has the stages
        "surface" and "tree", 0 if they were at hand, and "query".

    Raises:
        PlanError: a point lies outside the scan.
    """
    at_hand = isinstance(source, NativeSurface)
    volume = source.volume if isinstance(source, NativeSurface) else source
    points = np.asarray(pattern.points_m, dtype=np.float64)
    check_inside(volume.geometry, points)
    surface = source if isinstance(source, NativeSurface) else baseline_surface(source)
    began = time.perf_counter()
    _, nearest = surface.tree.query(points)
    depth_m = surface.points_m[nearest, 2]
    asked = time.perf_counter() - began
    intensity = _intensity(surface.volume, np.column_stack([points, depth_m]))
    return SurfaceSearch.untested(
        depth_m=depth_m,
        intensity=intensity,
        tau=surface.tau,
        coarse_depth_m=depth_m,
        method="kNN baseline: largest |first difference| of each A-scan, the nearest one in the lateral plane",
        seconds={name: 0.0 if at_hand else value for name, value in surface.seconds.items()} | {"query": asked},
    )


def _intensity(volume: Volume, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = volume.intensity_range
    index = volume.geometry.metric_to_voxel(points_m).T
    values = ndimage.map_coordinates(volume.array, index, output=np.float64, order=1, mode="nearest")
    return np.clip((values - low) / (high - low), 0.0, 1.0)
