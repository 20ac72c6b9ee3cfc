"""B-scans moved along the beam, A-scan by A-scan, by fractions of a voxel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from octn_ros.field.backend import numba_is_there


def resampled(
    planes: NDArray[np.float32], rows: NDArray[np.float32], shift: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return intensities between the voxels of A-scans, on the cubic of Catmull and Rom through the four around.

    Thread-safe; compiled where numba is there.

    Args:
        planes: [bscan, axial, lateral].
        rows: where, axial index [row]; A-scans are held at their ends.
        shift: what is added to it in each A-scan [bscan, lateral].

    Returns:
        [bscan, row, lateral].
    """
    shift = np.ascontiguousarray(shift, np.float32)  # a kernel is compiled for each layout
    if not numba_is_there():
        return resampled_reference(planes, rows, shift)
    # Loaded here, since it brings numba along.
    from octn_ros.training.resampling_kernel import resampled_compiled

    return resampled_compiled(np.ascontiguousarray(planes), rows, shift)


def resampled_reference(
    planes: NDArray[np.float32], rows: NDArray[np.float32], shift: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Do what `resampled` does, in plain NumPy."""
    bscans, axials, laterals = planes.shape
    places = rows[None, :, None] + shift[:, None, :]
    low = np.floor(places)
    share = places - low
    row = low.astype(np.int64)
    ascan = np.arange(bscans)[:, None, None] * (axials * laterals) + np.arange(laterals)
    flat = planes.ravel()
    a, b, c, d = (flat.take(ascan + (row + o).clip(0, axials - 1) * laterals) for o in (-1, 0, 1, 2))
    half = np.float32(0.5) * share
    return np.asarray(b + half * (c - a + share * (2 * a - 5 * b + 4 * c - d + share * (3 * (b - c) + d - a))))


def flattened(planes: NDArray[np.float32], depth: NDArray[np.float64]) -> tuple[NDArray[np.float32], int]:
    """Return B-scans with a sheet made flat, and in which row depth 0 of an A-scan lies whose sheet is at 0.

    Nothing is cut off: rows are added above.

    Args:
        planes: [bscan, axial, lateral].
        depth: of the sheet, axial index [bscan, lateral], at least 0.
    """
    top = math.ceil(float(depth.max()))
    return resampled(planes, np.arange(-top, planes.shape[1], dtype=np.float32), depth), top


def sharpened(planes: NDArray[np.float32], variance: float) -> NDArray[np.float32]:
    """Return B-scans [bscan, axial, lateral] with second differences along the beam taken away.

    A blur of that variance, in voxels squared, that comes later is made up for to second order.
    """
    padded = np.pad(planes, ((0, 0), (1, 1), (0, 0)), mode="edge")
    bend = padded[:, 2:] - 2.0 * planes + padded[:, :-2]
    return np.asarray(planes - np.float32(0.5 * variance) * bend)
