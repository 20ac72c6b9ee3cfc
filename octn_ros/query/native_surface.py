"""The surface of the measured voxels as the paper takes it (eq. 3): no filter, no neighbours, no field, no torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.volume.volume import Volume

_SLAB_VOXELS = 1 << 22


def native_surface(volume: Volume, *, rises_only: bool = False) -> NDArray[np.float64]:
    """Return the largest first difference along each A-scan of the raw voxels (eq. 3), as a point cloud.

    The paper's ground-truth surface and the one its kNN baseline starts from. The difference between voxels i and
    i + 1 stands for the place half-way between them. On speckle the largest difference often lies in the depth, so
    this is a reference to compare with, not a surface to plan on; filter the volume first for one that is.
    Deterministic (the shallowest of equals), thread-safe; memory beyond the answer stays below 100 MB.

    Args:
        volume: the measured or filtered C-scan.
        rises_only: take the largest rise instead of the largest |difference|, which the paper takes.

    Returns:
        Points [bscans * laterals, 3] as (x, y, z) in metres of the OCT frame, lateral fastest, one per A-scan;
        `.reshape(bscans, laterals, 3)[..., 2]` is the depth map.

    Raises:
        QueryError: no A-scan has a difference at all.
    """
    bscans, axials, laterals = volume.geometry.shape
    depth = np.empty((bscans, laterals))
    step = max(1, _SLAB_VOXELS // (axials * laterals))
    largest = 0.0
    low, high = volume.intensity_range
    for start in range(0, bscans, step):
        # Raw values are clipped to the range, as everywhere; the scaling to [0, 1] would not move the argmax.
        raw = np.clip(volume.array[start : start + step].astype(np.float32), low, high)
        difference = np.diff(raw, axis=1)
        if not rises_only:
            np.abs(difference, out=difference)
        depth[start : start + step] = np.argmax(difference, axis=1) + 0.5
        largest = max(largest, float(difference.max()))
    if not largest > 0.0:
        raise QueryError(
            "native_surface: expected intensities that change along the beam, got none that do; is the axial axis "
            "where it should be in [bscan, axial, lateral]?"
        )
    index: NDArray[np.float64] = np.empty((bscans, laterals, 3))
    index[..., 0], index[..., 1], index[..., 2] = np.arange(bscans)[:, None], depth, np.arange(laterals)
    return np.asarray(volume.geometry.voxel_to_metric(index.reshape(-1, 3)), dtype=np.float64)
