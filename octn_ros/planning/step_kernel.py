"""The strongest steps of A-scans in one compiled pass: what `StepLevels` finds, without its intermediates."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.model import in_parts
from octn_ros.field.compiled.options import KERNEL

# Rows of A-scans that a thread takes at a time.
_ROWS = 4


def strongest_steps_compiled(
    ascans: NDArray[np.float32], box: int, lateral: tuple[int, int], count: int
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Return place, strength and air level [bscan, lateral, count] of the strongest separate steps of each A-scan.

    Equal to `strongest_steps_reference` up to rounding and the order of the steps, which is that of their strength.
    Where there are fewer steps, the first other places with a strength of 0. Thread-safe.

    Args:
        ascans: A-scans [bscan, lateral, axial].
        box: axial voxels of one box.
        lateral: A-scans that are averaged along (bscan, lateral), odd, or 0 for none.
        count: steps of each A-scan, at most one for each place.
    """
    rows, columns, axials = ascans.shape
    count = min(count, axials + 1)
    place = np.empty((rows, columns, count), np.intp)
    strength, air = np.empty(place.shape, np.float32), np.empty(place.shape, np.float32)
    beside = lateral[0] // 2, lateral[1] // 2

    def part(start: int, stop: int) -> None:
        _rows(ascans, start, stop, box, beside, place, strength, air)

    in_parts(part, rows, _ROWS)
    return place, strength, air


@njit(**KERNEL)
def _rows(
    ascans: NDArray[np.float32],
    start: int,
    stop: int,
    box: int,
    beside: tuple[int, int],
    place: NDArray[np.intp],
    strength: NDArray[np.float32],
    air: NDArray[np.float32],
) -> None:
    _, columns, axials = ascans.shape
    pad = 5 * box
    across = np.empty((columns, axials), np.float32)
    padded = np.empty(axials + 2 * pad, np.float32)
    mean = np.empty(axials + 2 * pad - box + 1, np.float32)
    steps, above = np.empty(axials + 1, np.float32), np.empty(axials + 1, np.float32)
    smooth = padded[pad : pad + axials]
    for row in range(start, stop):
        _average(ascans, row, beside[0], across)
        for column in range(columns):
            for k in range(axials):
                smooth[k] = 0
            for offset in range(-beside[1], beside[1] + 1):
                neighbour = across[min(max(column + offset, 0), columns - 1)]
                for k in range(axials):
                    smooth[k] += neighbour[k]
            share = np.float32(1.0 / (2 * beside[1] + 1))
            for k in range(axials):
                smooth[k] *= share
            _box_means(padded, axials, box, mean)
            _step_levels(mean, box, above, steps)
            _strongest(steps, above, 2 * box, place[row, column], strength[row, column], air[row, column])


@njit(**KERNEL)
def _average(ascans: NDArray[np.float32], row: int, beside: int, across: NDArray[np.float32]) -> None:
    """Write the mean of a row of A-scans [lateral, axial] and those beside it; beyond the lattice its edge counts."""
    across[:] = 0
    for offset in range(-beside, beside + 1):
        neighbour = ascans[min(max(row + offset, 0), ascans.shape[0] - 1)]
        for column in range(across.shape[0]):
            for k in range(across.shape[1]):
                across[column, k] += neighbour[column, k]
    share = np.float32(1.0 / (2 * beside + 1))
    for column in range(across.shape[0]):
        for k in range(across.shape[1]):
            across[column, k] *= share


@njit(**KERNEL)
def _box_means(padded: NDArray[np.float32], axials: int, box: int, mean: NDArray[np.float32]) -> None:
    """Continue an A-scan beyond its ends at the level of its last box, in place, and write the mean of every box."""
    pad, held = (len(padded) - axials) // 2, min(box, axials)
    top, bottom = padded[pad : pad + held].mean(), padded[pad + axials - held : pad + axials].mean()
    for k in range(pad):
        padded[k] = top
        padded[pad + axials + k] = bottom
    for k in range(len(mean)):
        mean[k] = 0
    for offset in range(box):
        for k in range(len(mean)):
            mean[k] += padded[k + offset]
    share = np.float32(1.0 / box)
    for k in range(len(mean)):
        mean[k] *= share


@njit(**KERNEL)
def _step_levels(mean: NDArray[np.float32], box: int, above: NDArray[np.float32], steps: NDArray[np.float32]) -> None:
    """Write the air level above every place, and how much of a step lies there."""
    for k in range(len(steps)):
        a, b, c, d, e = mean[k], mean[k + box], mean[k + 2 * box], mean[k + 3 * box], mean[k + 4 * box]
        low = max(min(a, b), min(c, d))
        high = min(max(a, b), max(c, d))
        air = max(min(low, high), min(max(low, high), e))
        first, lowest = mean[k + 5 * box], mean[k + 6 * box]
        rise = max(first - e, np.float32(0.0))
        second = max(first, lowest)
        lowest = min(first, lowest)
        for n in range(7, 10):
            deeper = mean[k + n * box]
            second = min(second, max(lowest, deeper))
            lowest = min(lowest, deeper)
        above[k] = air
        steps[k] = math.sqrt(max(second - air, np.float32(0.0)) * rise)


@njit(**KERNEL)
def _strongest(
    steps: NDArray[np.float32],
    above: NDArray[np.float32],
    reach: int,
    place: NDArray[np.intp],
    strength: NDArray[np.float32],
    air: NDArray[np.float32],
) -> None:
    """Write the strongest places that none within reach surpasses, the strongest first."""
    count, found = len(place), 0
    for k in range(len(steps)):
        own = steps[k]
        if not own > (strength[count - 1] if found == count else np.float32(0.0)):
            continue
        summit = True
        for n in range(max(k - reach, 0), min(k + reach + 1, len(steps))):
            summit = summit and steps[n] <= own
        if not summit:
            continue
        n = min(found, count - 1)
        found = min(found + 1, count)
        while n > 0 and strength[n - 1] < own:
            place[n], strength[n] = place[n - 1], strength[n - 1]
            n -= 1
        place[n], strength[n] = k, own
    free = 0
    for n in range(found, count):
        while (place[:n] == free).any():
            free += 1
        place[n], strength[n] = free, 0
    for n in range(count):
        air[n] = above[place[n]]
