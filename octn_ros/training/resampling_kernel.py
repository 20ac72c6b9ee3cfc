"""Compiled: A-scans read between their voxels, as `resampling.resampled_reference` does."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.model import in_parts
from octn_ros.field.compiled.options import KERNEL


def resampled_compiled(
    planes: NDArray[np.float32], rows: NDArray[np.float32], shift: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Do what `resampled_reference` does, on the threads that run kernels; equal to it but for rounding (tested)."""
    answer = np.empty((len(planes), len(rows), planes.shape[2]), np.float32)

    def part(start: int, stop: int) -> None:
        for bscan in range(start, stop):
            _resample(planes[bscan], rows, shift[bscan], answer[bscan])

    in_parts(part, len(planes), 1)
    return answer


@njit(**KERNEL)
def _resample(
    plane: NDArray[np.float32], rows: NDArray[np.float32], shift: NDArray[np.float32], answer: NDArray[np.float32]
) -> None:
    last = plane.shape[0] - 1
    half = np.float32(0.5)
    for row in range(len(rows)):
        for lateral in range(plane.shape[1]):
            place = rows[row] + shift[lateral]
            low = math.floor(place)
            share = np.float32(place - low)
            at = int(low)
            a = plane[min(max(at - 1, 0), last), lateral]
            b = plane[min(max(at, 0), last), lateral]
            c = plane[min(max(at + 1, 0), last), lateral]
            d = plane[min(max(at + 2, 0), last), lateral]
            bend = 2 * a - 5 * b + 4 * c - d + share * (3 * (b - c) + d - a)
            answer[row, lateral] = b + half * share * (c - a + share * bend)
