"""A fit's first state taken from the data: block averages of the volume as features that the network passes through."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import nn

from octn_ros.errors import TrainingError
from octn_ros.field import NeuralModel
from octn_ros.field.grid_level import GridLevel
from octn_ros.volume import Volume


def start_from_data(model: NeuralModel, volume: Volume) -> None:
    """Set a model, in place, to the volume averaged over the cells of its finest level.

    The first feature of each vertex there becomes the mean of the voxels around it, weighted as interpolation weights
    them: the adjoint of the interpolation, normalised. The first neuron of every layer carries that feature to the
    output unchanged; the other neurons keep their random weights, but begin without a say in the output. So the field
    before the first step is the interpolated block average, and every parameter can still learn.

    Args:
        model: on any device.
        volume: the C-scan; read B-scan by B-scan, not copied.

    Raises:
        TrainingError: the finest level is hashed: a row there stands for many places and has no one average.
    """
    level = model.grid.grid_levels[-1]
    if not level.dense:
        raise TrainingError(
            f"expected a finest grid level that stores its {np.prod(level.vertices)} vertices, got one hashed into "
            f"{level.size} rows; raise log2_table_size, or switch start_from_data off"
        )
    average = torch.from_numpy(block_average(volume, level)).flatten().to(model.grid.table.device)
    column = (len(model.grid.grid_levels) - 1) * model.grid.config.features
    hidden = [layer for layer in model.network.hidden if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        model.grid.table[level.first_row : level.first_row + level.size, 0] = average
        for number, layer in enumerate(hidden):
            layer.weight[0] = 0.0
            layer.weight[0, column if number == 0 else 0] = 1.0
            layer.bias[0] = 0.0
        model.network.output.weight.zero_()
        model.network.output.weight[0, 0] = 1.0
        model.network.output.bias.zero_()


def block_average(volume: Volume, level: GridLevel) -> NDArray[np.float32]:
    """Return the mean intensity around each vertex of a grid level, [bscan, axial, lateral].

    A voxel counts for the vertices of its cell as interpolation weights them, which is separable by axis. A vertex
    that no voxel reaches, where cells are finer than voxels, takes the mean of the vertices beside it.
    """
    bscans, axials, laterals = volume.geometry.shape
    (lateral_scale, axial_scale, bscan_scale), (columns, rows, layers) = level.scale, level.vertices
    to_columns, to_rows, to_layers = (
        _averages(count, scale, vertices)
        for count, scale, vertices in (
            (laterals, lateral_scale, columns), (axials, axial_scale, rows), (bscans, bscan_scale, layers)
        )
    )  # fmt: skip
    planes = np.empty((bscans, rows * columns), np.float32)
    for bscan in range(bscans):
        across = (to_columns @ volume.normalized((bscan,)).T).T
        planes[bscan] = (to_rows @ across).ravel()
    return np.asarray(to_layers @ planes, np.float32).reshape(layers, rows, columns)


def _averages(count: int, scale: float, vertices: int) -> Any:
    """Return the sparse matrix [vertices, count] of the voxels' weights along one axis; its rows sum to one."""
    position = np.arange(count) * (scale / (count - 1)) + 0.5
    cell = np.minimum(np.floor(position).astype(np.int64), vertices - 2)
    share = position - cell
    voxel = np.arange(count)
    weights = sparse.coo_matrix(
        (np.r_[1.0 - share, share], (np.r_[cell, cell + 1], np.r_[voxel, voxel])), shape=(vertices, count)
    ).tocsr()
    sums = np.asarray(weights.sum(axis=1)).ravel()
    reached = np.flatnonzero(sums > 1e-6)
    # Between reached vertices the averages are interpolated; beyond them the nearest counts.
    place = np.interp(np.arange(vertices), reached, np.arange(len(reached)))
    before = np.floor(place).astype(np.int64)
    after = np.minimum(before + 1, len(reached) - 1)
    vertex = np.arange(vertices)
    fill = sparse.coo_matrix(
        (np.r_[1.0 - (place - before), place - before], (np.r_[vertex, vertex], np.r_[before, after])),
        shape=(vertices, len(reached)),
    )
    normalised = sparse.diags(1.0 / sums[reached]) @ weights[reached]
    return sparse.csr_matrix(fill @ normalised, dtype=np.float32)
