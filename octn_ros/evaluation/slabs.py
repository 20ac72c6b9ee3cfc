"""Whole volumes worked through in slabs of B-scans, with as many on either side as a filter reaches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from octn_ros.volume import Volume

_SLAB_VOXELS = 1 << 23


def slabs(shape: tuple[int, int, int], halo: int) -> Iterator[tuple[int, int, slice]]:
    """Yield the first B-scan of each slab of at most 8 million voxels, the one after its last, and both with a halo.

    Args:
        shape: of the volume, [bscan, axial, lateral].
        halo: B-scans on either side, where there are so many; at least 1, so that a slab always has the two B-scans
            that a geometry needs.
    """
    step = max(1, _SLAB_VOXELS // (shape[1] * shape[2]))
    for first in range(0, shape[0], step):
        last = min(first + step, shape[0])
        yield first, last, slice(max(0, first - halo), min(shape[0], last + halo))


def slab_volume(like: Volume, intensity: NDArray[np.float32]) -> Volume:
    """Return intensities in [0, 1] of some B-scans [bscan, axial, lateral] as a volume, placed where `like` begins."""
    geometry = replace(like.geometry, shape=intensity.shape)
    return replace(like, array=np.ascontiguousarray(intensity), geometry=geometry, intensity_range=(0.0, 1.0))
