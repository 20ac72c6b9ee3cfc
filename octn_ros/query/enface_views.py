"""A scan seen along the beam: maximum and mean, the mean of a layer below the surface."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.query.lattice import Lattice
from octn_ros.query.surface import SurfaceMap
from octn_ros.volume import Volume

EnfaceMode = Literal["mip", "mean"]
_CHUNK_POINTS = 1 << 18


def enface(
    source: Field | Volume, mode: EnfaceMode = "mip", *, progress: Callable[[float], None] | None = None
) -> NDArray[np.float32]:
    """Return the view along the beam of a field or a measured volume, at its native lateral voxels.

    A field is evaluated at every voxel, some B-scans at a time; for a quick view take the volume. Thread-safe; any
    device.

    Args:
        source: the field or volume to look at.
        mode: "mip" for the largest intensity of each A-scan, "mean" for its mean.
        progress: called with the share that is done, 0 to 1; what it raises ends the query.

    Returns:
        Intensities [bscan, lateral].

    Raises:
        QueryError: the mode is unknown.
    """
    if mode not in ("mip", "mean"):
        raise QueryError(f"enface: expected the mode mip or mean, got {mode!r}")
    if isinstance(source, Volume) and mode == "mip":
        # The largest raw value of an A-scan is its largest intensity: no voxel needs to become a float for it.
        if progress:
            progress(1.0)
        return source.intensity_of(source.array.max(axis=1))
    along_beam = np.max if mode == "mip" else np.mean
    lattice = Lattice.over(source.geometry, name="enface")
    view = np.empty((lattice.shape[0], lattice.shape[2]), dtype=np.float32)
    for planes in lattice.slabs():
        view[planes] = along_beam(lattice.evaluate(source, planes), axis=1)
        if progress:
            progress(planes.stop / len(view))
    return view


def layer_mean(field: Field, surface: SurfaceMap, from_m: float, to_m: float) -> NDArray[np.float32]:
    """Return the mean intensity of a layer that follows the surface, over the A-scans of a surface map.

    Depths are optical paths, as everything axial; below the surface the geometric depth is smaller by the refractive
    index. The mean is over depths one axial voxel apart or less, both ends included. Thread-safe; any device.

    Args:
        field: the field to look at.
        surface: its surface, from `surface_map`.
        from_m: depth of the layer's top below the surface; negative values lie above it.
        to_m: depth of its bottom.

    Returns:
        Mean intensities [bscan, lateral] over the map's lattice, NaN where the layer leaves the scan.

    Raises:
        QueryError: the depths are not finite and in order, or further apart than the scan is deep.
    """
    geometry = field.geometry
    first, extent = geometry.origin_m[2], geometry.extent_m[2]
    if not (math.isfinite(from_m) and math.isfinite(to_m) and 0.0 < to_m - from_m <= extent):
        raise QueryError(
            f"layer_mean: expected depths from < to below the surface, at most {extent * 1e3:.3f} mm apart, got "
            f"{from_m * 1e3:g} to {to_m * 1e3:g} mm"
        )
    samples = math.ceil((to_m - from_m) / geometry.spacing_m[1]) + 1
    depths = surface.depth_m[..., None] + np.linspace(from_m, to_m, samples)
    inside = (depths[..., 0] >= first - 1e-9) & (depths[..., -1] <= first + extent + 1e-9)
    y, x = np.nonzero(inside)
    view = np.full(inside.shape, np.nan, dtype=np.float32)
    step = max(1, _CHUNK_POINTS // samples)
    for start in range(0, len(y), step):
        rows, columns = y[start : start + step], x[start : start + step]
        metres = np.empty((len(rows), samples, 3))
        metres[..., 0] = surface.lateral_m[columns, None]
        metres[..., 1] = surface.bscan_m[rows, None]
        metres[..., 2] = depths[rows, columns]
        points = geometry.metric_to_canonical(metres).reshape(-1, 3).astype(np.float32)
        with torch.no_grad():
            values = field.evaluate(torch.from_numpy(points).to(field.device)).cpu().numpy()
        view[rows, columns] = values.reshape(len(rows), samples).mean(axis=1)
    return view
