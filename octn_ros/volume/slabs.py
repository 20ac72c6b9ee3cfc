"""Large arrays read slab by slab, so that there is never a second copy of the whole in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError

_SLAB_BYTES = 2**24
_READ_BYTES = 2**20  # gzip makes a copy of what it is asked for


def read_fortran_order(
    file: BinaryIO,
    stored_type: np.dtype[Any],
    out: NDArray[Any],
    convert: Callable[[NDArray[Any]], NDArray[Any]] = lambda slab: slab,
) -> None:
    """Fill an array from a stream whose first axis runs fastest, as NIfTI and MATLAB have it.

    Args:
        file: where to read; only as much as the array needs is read.
        stored_type: type of one voxel in the stream, with its byte order.
        out: array of three axes to fill.
        convert: applied to every slab before it is stored.

    Raises:
        VolumeError: the stream ends too early.
    """
    first, second, third = out.shape
    plane = first * second * stored_type.itemsize
    step = max(1, min(third, _SLAB_BYTES // max(1, plane)))
    buffer = bytearray(step * plane)
    for start in range(0, third, step):
        count = min(step, third - start)
        view = memoryview(buffer)[: count * plane]
        _fill(file, view)
        slab = np.frombuffer(view, stored_type).reshape(count, second, first)
        out[:, :, start : start + count] = convert(slab).transpose(2, 1, 0)


def _fill(file: BinaryIO, view: memoryview) -> None:
    while len(view):
        count = file.readinto(view[:_READ_BYTES])  # type: ignore[attr-defined]
        if not count:
            raise VolumeError(f"the file is damaged or truncated: {len(view):,} bytes of voxels are missing")
        view = view[count:]
