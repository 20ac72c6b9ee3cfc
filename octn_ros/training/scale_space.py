"""A volume at several scales: what the vertices of a field's levels hold when only its network is learned."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import gaussian_filter1d

from octn_ros.errors import TrainingError
from octn_ros.field.grid_level import GridLevel
from octn_ros.field.hash_grid import HashGrid
from octn_ros.training.resampling import flattened, resampled, sharpened
from octn_ros.training.tissue_sheet import TissueSheet

# Intensities [bscan, axial, lateral] of those B-scans.
Planes = Callable[[slice], NDArray[np.float32]]
FEATURES = 2  # of each level: averaged along the tissue, averaged in place
_SLAB_VOXELS = 1 << 23  # worked on at a time


@dataclass(frozen=True)
class Average:
    """Standard deviations, in voxels, of the Gaussians behind one feature of a level.

    Attributes:
        follows: whether it is taken along the tissue, so that slopes blur nothing, or in place.
        lateral: across the beam.
        axial: along it.
        slow: from B-scan to B-scan.
    """

    follows: bool
    lateral: float
    axial: float
    slow: float

    @property
    def reach(self) -> int:
        """B-scans on each side that count."""
        return math.ceil(3.0 * self.slow)


def level_averages(levels: Sequence[GridLevel], shape: tuple[int, int, int]) -> list[tuple[Average, Average]]:
    """Return the averages behind the features of each level of a grid for a volume of that shape, coarsest first.

    The finest level holds voxels as they are. The n-th one below it averages over some 2^n of its cells across the
    beam, along the tissue without blurring it along the beam, in place along the beam too; and over n B-scans.
    """
    cell = (shape[2] - 1) / levels[-1].scale[0]
    averages = [(Average(True, 0.0, 0.0, 0.0), Average(False, 0.0, 0.0, 0.0))]
    for below in range(1, len(levels)):
        across = cell * 2.0**below
        averages.append((Average(True, 1.25 * across, 0.0, below), Average(False, 2.0 * across, 0.75 * across, below)))
    return averages[::-1]


def check_scales(grid: HashGrid) -> None:
    """Raise TrainingError, in words, if a grid cannot hold a volume at several scales."""
    if grid.config.features != FEATURES:
        raise TrainingError(
            f"expected {FEATURES} features a level to learn from neighbours, along the tissue and in place, got "
            f"{grid.config.features}; set them so, or learn from voxels"
        )
    for number, level in enumerate(grid.grid_levels):
        if not level.dense:
            raise TrainingError(
                f"expected levels that store every vertex, got level {number} with {level.size} shared rows; raise "
                "log2_table_size, or learn from voxels"
            )


def fill_with_scales(
    grid: HashGrid, planes: Planes, sheet: TissueSheet, shape: tuple[int, int, int], cancelled: Callable[[], bool]
) -> bool:
    """Set a grid's whole table, in place, to a volume at the scales of its levels; return whether it was done.

    Between B-scans vertices take what is interpolated linearly: along the sheet for the first feature of a level, in
    place for the second.

    Args:
        grid: on any device; every level stores all its vertices and has `FEATURES` features.
        planes: the volume; asked for slabs of B-scans.
        sheet: what the tissue follows there.
        shape: of the volume (bscan, axial, lateral).
        cancelled: asked several times for every slab; True ends it with the table half filled.

    Raises:
        TrainingError: a level shares rows between vertices, or has another number of features.
    """
    bscans, axials, laterals = shape
    check_scales(grid)
    levels = grid.grid_levels
    averages = level_averages(levels, shape)
    halo = 1 + max(average.reach for pair in averages for average in pair)
    step = max(1, _SLAB_VOXELS // (axials * laterals))
    for first in range(0, bscans, step):
        start = max(0, first - halo)
        end = min(bscans, first + step + halo)
        slab = planes(slice(start, end))
        for level, pair in zip(levels, averages, strict=True):
            columns, rows, layers = level.vertices
            positions = _vertex_places(bscans, level.scale[2], layers).clip(0.0, bscans - 1.0)
            mine = np.flatnonzero((positions >= first) & (positions < first + step))
            table = grid.table.detach()[level.first_row : level.first_row + level.size]
            table = table.view(layers, rows, columns, FEATURES)
            if mine.size == 0:
                continue
            within = slice(int(mine[0]), int(mine[-1]) + 1)
            sharp = sharpened(slab, _blur_of_cells(axials, level.scale[1]))
            for feature, average in enumerate(pair):
                if cancelled():
                    return False
                part = _around(positions[within], average.reach, bscans)
                values = _layers(
                    level,
                    average,
                    sharp[part.start - start : part.stop - start],
                    sheet.depth[part],
                    positions[within] - part.start,
                    sheet.at(positions[within]),
                )
                table[within, :, :, feature] = torch.from_numpy(values).to(table.device)
    return True


def features_between(
    levels: Sequence[GridLevel],
    planes: NDArray[np.float32],
    sheet: TissueSheet,
    position: float,
    depth: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return what a grid, filled with a few B-scans, says of a B-scan between them [axial * lateral, width].

    Equal to `fill_with_scales` and a query at the voxels of that B-scan (tested), without a table.

    Args:
        levels: of a grid for a volume of these B-scans.
        planes: the B-scans [bscan, axial, lateral], at least two.
        sheet: of these B-scans.
        position: of the B-scan in between, counted in B-scans from the first.
        depth: where the sheet lies there [lateral]; layers around it are as far from it as the sheet says.
    """
    count, axials, laterals = planes.shape
    answer = np.empty((axials, laterals, len(levels) * FEATURES), np.float32)
    off = depth - sheet.at(np.array([position]))[0]
    pairs = level_averages(levels, planes.shape)
    for number, (level, pair) in enumerate(zip(levels, pairs, strict=True)):
        columns, rows, layers = level.vertices
        places = _vertex_places(count, level.scale[2], layers).clip(0.0, count - 1.0)
        at_place = _interpolation(np.array([position]), count, level.scale[2], layers, level.smooth)
        used = at_place.indices
        across = _interpolation(np.arange(laterals), laterals, level.scale[0], columns, level.smooth)
        along = _interpolation(np.arange(axials), axials, level.scale[1], rows, level.smooth)
        sharp = sharpened(planes, _blur_of_cells(axials, level.scale[1]))
        for feature, average in enumerate(pair):
            values = _layers(level, average, sharp, sheet.depth, places[used], sheet.at(places[used]) + off)
            plane = np.tensordot(at_place.data, values, axes=1)
            answer[..., number * FEATURES + feature] = along @ (across @ plane.T).T
    return answer.reshape(axials * laterals, -1)


def _layers(
    level: GridLevel,
    average: Average,
    planes: NDArray[np.float32],
    depth: NDArray[np.float64],
    positions: NDArray[np.float64],
    depth_there: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return what the vertices [layer, row, column] of some layers of a level hold of one feature.

    Args:
        level: the level.
        average: what the feature is.
        planes: B-scans [bscan, axial, lateral] around the layers, sharpened for the level's blur along the beam.
        depth: of the sheet in them [bscan, lateral].
        positions: of the layers, counted in B-scans from the first of these.
        depth_there: of the sheet in the layers [layer, lateral].
    """
    _, axials, laterals = planes.shape
    column_places = _vertex_places(laterals, level.scale[0], level.vertices[0]).clip(0.0, laterals - 1.0)
    row_places = _vertex_places(axials, level.scale[1], level.vertices[1])
    top = 0
    if average.follows:
        above = math.floor(depth.min())  # whole, so that it does not matter which B-scans are there
        planes, top = flattened(planes, depth - above)
        depth_there = _between(np.asarray(depth_there - above).T, column_places).T
    else:
        depth_there = np.zeros((len(positions), len(column_places)))
    planes = _between(np.moveaxis(_smoothed(planes, average.lateral, 2), 2, 0), column_places)
    planes = np.moveaxis(planes, 0, 2)
    planes = _smoothed(_smoothed(planes, average.axial, 1), average.slow, 0)
    return resampled(_between(planes, positions), np.float32(row_places + top), -depth_there)


def _vertex_places(count: int, scale: float, vertices: int) -> NDArray[np.float64]:
    """Return where a level's vertices lie along one axis, in voxels of `count`; the outermost lie beyond them."""
    return np.asarray((np.arange(vertices) - 0.5) * ((count - 1) / scale))


def _blur_of_cells(count: int, scale: float) -> float:
    """Return the mean variance, in voxels squared, of linear interpolation at the voxels between vertices."""
    place = np.arange(count) * (scale / (count - 1)) + 0.5
    share = place - np.floor(place)
    return float((share * (1.0 - share)).mean() * ((count - 1) / scale) ** 2)


def _around(positions: NDArray[np.float64], reach: int, count: int) -> slice:
    """Return the B-scans that layers at rising positions are made of."""
    return slice(max(0, int(positions[0]) - reach), min(count, int(positions[-1]) + 2 + reach))


def _smoothed(values: NDArray[np.float32], sigma: float, axis: int) -> NDArray[np.float32]:
    if sigma <= 0.0:
        return values
    return np.asarray(gaussian_filter1d(values, sigma, axis=axis, mode="nearest", truncate=3.0))


def _between(values: NDArray[np.floating], places: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return values [n, ...] interpolated linearly along their first axis at places [m]; held at the ends."""
    before = places.astype(np.int64).clip(0, max(len(values) - 2, 0))
    after = np.minimum(before + 1, len(values) - 1)
    share = np.float32(places - before).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(values[before] * (1 - share) + values[after] * share, np.float32)


def _interpolation(
    index: NDArray[np.number], count: int, scale: float, vertices: int, smooth: bool
) -> sparse.csr_matrix:
    """Return the matrix [len(index), vertices] of a level's weights along one axis, at voxel indices of `count`."""
    position = np.asarray(index) * (scale / (count - 1)) + 0.5
    cell = np.minimum(position.astype(np.int64), vertices - 2)
    share = position - cell
    share = share * share * (3.0 - 2.0 * share) if smooth else share
    row = np.arange(len(cell))
    entries = np.r_[1.0 - share, share], (np.r_[row, row], np.r_[cell, cell + 1])
    return sparse.csr_matrix(sparse.coo_matrix(entries, shape=(len(cell), vertices)), dtype=np.float32)
