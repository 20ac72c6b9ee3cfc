"""The points of a band among samples in a box of voxels, counted first and then listed; compiled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.model import in_parts
from octn_ros.field.compiled.options import KERNEL
from octn_ros.query.band_index import BLOCK

# Planes that a thread takes at a time.
_PLANES = 8


@dataclass(frozen=True, eq=False)
class BandSearch:
    """Where the points of a band are looked for.

    Attributes:
        samples: intensities in a box of voxels [bscan, axial, lateral].
        first: voxel that the box begins at, along each axis.
        matching: blocks that can hold points of the band [bscan, axial, lateral], the first with the box's first voxel.
        inside: which voxels count [bscan, axial, lateral], or a part of that shape that broadcasts.
        low: lowest intensity.
        high: highest intensity.
        half_open: whether `high` itself is left out.
    """

    samples: NDArray[np.float32]
    first: tuple[int, int, int]
    matching: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    low: np.float32
    high: np.float32
    half_open: bool

    def count(self) -> NDArray[np.int64]:
        """Return the number of points on each plane [bscan]."""
        counts = np.zeros(len(self.samples), np.int64)
        if self.matching.any():
            arguments = self._arguments()
            in_parts(lambda start, stop: _count(*arguments, start, stop, counts), len(counts), _PLANES)
        return counts

    def list_points(
        self,
        counts: NDArray[np.int64],
        axes_m: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
        points_m: NDArray[np.float64],
        intensity: NDArray[np.float32],
    ) -> None:
        """Write the points, ordered by bscan, axial, lateral.

        Args:
            counts: of each plane.
            axes_m: x [lateral], y [bscan] and z [axial] of the box.
            points_m: written: (x, y, z) [N, 3].
            intensity: written: intensity of each [N].
        """
        places = np.concatenate([[0], np.cumsum(counts)])
        if len(intensity):
            arguments = self._arguments()

            def part(start: int, stop: int) -> None:
                _list(*arguments, start, stop, places, *axes_m, points_m, intensity)

            in_parts(part, len(counts), _PLANES)

    def _arguments(self) -> tuple[object, ...]:
        inside = np.broadcast_to(self.inside, self.samples.shape)
        return self.samples, self.first, self.matching, inside, self.low, self.high, self.half_open


@njit(**KERNEL)
def _count(
    samples: NDArray[np.float32],
    first: tuple[int, int, int],
    matching: NDArray[np.bool_],
    inside: NDArray[np.bool_],
    low: np.float32,
    high: np.float32,
    half_open: bool,
    start: int,
    stop: int,
    counts: NDArray[np.int64],
) -> None:
    _, rows, columns = samples.shape
    for plane in range(start, stop):
        layer = matching[(first[0] % BLOCK + plane) // BLOCK]
        total = 0
        for row in range(rows):
            blocks = layer[(first[1] % BLOCK + row) // BLOCK]
            for block in range(len(blocks)):
                if blocks[block]:
                    begin = max(block * BLOCK - first[2] % BLOCK, 0)
                    for column in range(begin, min((block + 1) * BLOCK - first[2] % BLOCK, columns)):
                        value = samples[plane, row, column]
                        below = value < high or (value == high and not half_open)
                        total += int(value >= low and below and inside[plane, row, column])
        counts[plane] = total


@njit(**KERNEL)
def _list(
    samples: NDArray[np.float32],
    first: tuple[int, int, int],
    matching: NDArray[np.bool_],
    inside: NDArray[np.bool_],
    low: np.float32,
    high: np.float32,
    half_open: bool,
    start: int,
    stop: int,
    places: NDArray[np.int64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    points_m: NDArray[np.float64],
    intensity: NDArray[np.float32],
) -> None:
    _, rows, columns = samples.shape
    for plane in range(start, stop):
        place, end = places[plane], places[plane + 1]
        if place == end:
            continue
        layer = matching[(first[0] % BLOCK + plane) // BLOCK]
        for row in range(rows):
            blocks = layer[(first[1] % BLOCK + row) // BLOCK]
            for block in range(len(blocks)):
                if blocks[block]:
                    begin = max(block * BLOCK - first[2] % BLOCK, 0)
                    for column in range(begin, min((block + 1) * BLOCK - first[2] % BLOCK, columns)):
                        value = samples[plane, row, column]
                        below = value < high or (value == high and not half_open)
                        if value >= low and below and inside[plane, row, column]:
                            points_m[place, 0] = x[column]
                            points_m[place, 1] = y[plane]
                            points_m[place, 2] = z[row]
                            intensity[place] = value
                            place += 1
