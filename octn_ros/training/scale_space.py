"""A volume at several scales: what the vertices of a field's levels hold when only its network is learned."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import gaussian_filter1d

from octn_ros.errors import TrainingError
from octn_ros.field.grid_level import GridLevel
from octn_ros.field.hash_grid import HashGrid
from octn_ros.training.data_start import axis_averages

# Intensities [axial, lateral] of the B-scan of that number.
Plane = Callable[[int], NDArray[np.float32]]


def fill_with_scales(grid: HashGrid, plane: Plane, shape: tuple[int, int, int], cancelled: Callable[[], bool]) -> bool:
    """Set a grid's whole table, in place, to a volume at the scales of its levels; return whether it was done.

    Every vertex takes the mean of the voxels around it in the plane of the B-scans, weighted as interpolation weights
    them; between B-scans it takes what is interpolated linearly. Of a level's features the first does so from the
    B-scans as they are, the others after a Gaussian of 1, 2, ... B-scans along the slow axis.

    Args:
        grid: on any device; every level stores all its vertices.
        plane: the volume; asked once for each B-scan and level.
        shape: of the volume (bscan, axial, lateral).
        cancelled: asked before every B-scan; True ends it with the table half filled.

    Raises:
        TrainingError: a level shares rows between vertices.
    """
    bscans, axials, laterals = shape
    for number, level in enumerate(grid.grid_levels):
        _check_dense(number, level)
        sigma = _axial_sigma(level, grid.grid_levels[-1], shape)
        table = grid.table.detach()[level.first_row : level.first_row + level.size]
        columns, rows, layers = level.vertices
        to_columns = axis_averages(laterals, level.scale[0], columns)
        to_rows = axis_averages(axials, level.scale[1], rows)
        planes = np.empty((bscans, rows * columns), np.float32)
        for bscan in range(bscans):
            if cancelled():
                return False
            averaged = (to_columns @ plane(bscan).T).T
            planes[bscan] = (to_rows @ _smoothed(averaged, sigma)).ravel()
        between = _between(bscans, level.scale[2], layers)
        for feature in range(grid.config.features):
            values = between @ _smoothed(planes, feature)
            table[:, feature].copy_(torch.from_numpy(values.reshape(-1)))
    return True


def features_between(
    levels: Sequence[GridLevel], features: int, planes: Sequence[NDArray[np.float32]], position: float
) -> NDArray[np.float32]:
    """Return what a grid, filled with a few B-scans, says of a B-scan between them [axial * lateral, width].

    Equal to `fill_with_scales` and a query at the voxels of that B-scan (tested), without a table: everything is
    linear and separable by axis, so the B-scans are summed first.

    Args:
        levels: of a grid for a volume of these B-scans.
        features: of each level.
        planes: the B-scans, at least two.
        position: of the B-scan in between, counted in B-scans from the first.
    """
    count, (axials, laterals) = len(planes), planes[0].shape
    stack = np.stack([plane.ravel() for plane in planes])
    answer = np.empty((axials, laterals, len(levels) * features), np.float32)
    for number, level in enumerate(levels):
        _check_dense(number, level)
        sigma = _axial_sigma(level, levels[-1], (count, axials, laterals))
        columns, rows, layers = level.vertices
        at_place = _interpolation(np.array([position]), count, level.scale[2], layers, level.smooth)
        across = _interpolation(np.arange(laterals), laterals, level.scale[0], columns, level.smooth)
        along = _interpolation(np.arange(axials), axials, level.scale[1], rows, level.smooth)
        # Means around the vertices, and interpolated between them again: one matrix an axis.
        across = across @ axis_averages(laterals, level.scale[0], columns)
        along = along @ axis_averages(axials, level.scale[1], rows)
        for feature in range(features):
            weights = at_place @ _between(count, level.scale[2], layers) @ _smoothed(np.eye(count), feature)
            summed = _smoothed((np.float32(weights) @ stack).reshape(axials, laterals), sigma)
            answer[..., number * features + feature] = along @ (across @ summed.T).T
    return answer.reshape(axials * laterals, -1)


def _axial_sigma(level: GridLevel, finest: GridLevel, shape: tuple[int, int, int]) -> float:
    """Return the width in voxels of the Gaussian along the beam that goes with a level's cells across it.

    A mean over the vertices' surroundings, interpolated between vertices, is about as wide as a Gaussian of 0.58 cells.
    """
    coarser = finest.scale[0] / level.scale[0]
    return 0.0 if coarser == 1.0 else 0.58 * coarser * (shape[1] - 1) / finest.scale[1]


def _smoothed(planes: NDArray[np.floating], sigma: float) -> NDArray[np.floating]:
    return gaussian_filter1d(planes, sigma, axis=0, mode="nearest") if sigma > 0 else planes


def _between(count: int, scale: float, vertices: int) -> sparse.csr_matrix:
    """Return the matrix [vertices, count] that interpolates linearly between samples, and holds them beyond."""
    vertex = np.arange(vertices)
    position = ((vertex - 0.5) * ((count - 1) / scale)).clip(0.0, count - 1.0)
    before = np.minimum(position.astype(np.int64), count - 2)
    return _two_a_row(before, position - before, count)


def _interpolation(
    index: NDArray[np.number], count: int, scale: float, vertices: int, smooth: bool
) -> sparse.csr_matrix:
    """Return the matrix [len(index), vertices] of a level's weights along one axis, at voxel indices of `count`."""
    position = np.asarray(index) * (scale / (count - 1)) + 0.5
    cell = np.minimum(position.astype(np.int64), vertices - 2)
    share = position - cell
    return _two_a_row(cell, share * share * (3.0 - 2.0 * share) if smooth else share, vertices)


def _two_a_row(first: NDArray[np.int64], share: NDArray[np.float64], columns: int) -> sparse.csr_matrix:
    row = np.arange(len(first))
    entries = np.r_[1.0 - share, share], (np.r_[row, row], np.r_[first, first + 1])
    return sparse.csr_matrix(sparse.coo_matrix(entries, shape=(len(first), columns)), dtype=np.float32)


def _check_dense(number: int, level: GridLevel) -> None:
    if not level.dense:
        raise TrainingError(
            f"expected levels that store every vertex, got level {number} with {level.size} shared rows; raise "
            "log2_table_size, or learn from voxels"
        )
