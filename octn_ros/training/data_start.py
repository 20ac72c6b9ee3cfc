"""A fit's first state taken from the data: block averages of the volume as features that the network passes through."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from octn_ros.field import Field, NeuralModel
from octn_ros.field.grid_level import GridLevel
from octn_ros.volume import Volume, VolumeGeometry


def start_from_data(model: NeuralModel, volume: Volume, cancelled: Callable[[], bool]) -> None:
    """Set a model, in place, to the volume averaged over the cells of its finest level that stores every vertex.

    The first feature of each vertex there becomes the mean of the voxels around it, weighted as interpolation weights
    them: the adjoint of the interpolation, normalised. The first neuron of every layer carries that feature to the
    output unchanged; the other neurons keep their random weights, but begin without a say in the output. So the field
    before the first step is the interpolated block average, and every parameter can still learn. A model whose levels
    are all hashed is left as it is: a row there stands for many places and has no one average.

    Args:
        model: on any device.
        volume: the C-scan; read B-scan by B-scan, not copied.
        cancelled: asked before every B-scan; True leaves the model as it is.
    """
    number = _carrying_level(model)
    if number is None:
        return
    average = block_average(volume.normalized, model.grid.grid_levels[number], volume.geometry, cancelled)
    if average is None:
        return
    *hidden, output = model.network.linear_layers
    with torch.no_grad():
        _carrier(model, number).copy_(torch.from_numpy(average).flatten())
        for place, layer in enumerate(hidden):
            layer.weight[0] = 0.0
            layer.weight[0, number * model.grid.config.features if place == 0 else 0] = 1.0
            layer.bias[0] = 0.0
        output.weight.zero_()
        output.weight[0, 0] = 1.0
        output.bias.zero_()


def follow_data(
    model: NeuralModel,
    volume: Volume,
    field: Field,
    error: Callable[[NeuralModel], float],
    cancelled: Callable[[], bool],
) -> None:
    """Move a model, in place, from the scan it was fitted to towards a new one of the same geometry.

    Of three states the one with the least error is kept: the model as it is; with the block average of what the new
    scan has more than the field added to the feature that carries block averages, which serves small changes; and
    begun anew by `start_from_data`, which serves large ones.

    Args:
        model: a copy of the field's model, on any device.
        volume: the new C-scan.
        field: the field of the model as it is.
        error: how far a model is from the new scan.
        cancelled: asked before every B-scan; True leaves the model as it is.
    """
    number = _carrying_level(model)
    if number is None:
        return
    bscan, axial, lateral = (torch.linspace(-1.0, 1.0, n, device=field.device) for n in volume.geometry.shape)

    def difference(index: tuple[int]) -> NDArray[np.float32]:
        rendered = field.lattice(lateral, axial, bscan[index[0] : index[0] + 1])[0]
        return volume.normalized(index) - rendered.cpu().numpy()

    change = block_average(difference, model.grid.grid_levels[number], volume.geometry, cancelled)
    if change is None:
        return
    states = [(error(model), _copied(model))]
    with torch.no_grad():
        _carrier(model, number).add_(torch.from_numpy(change).flatten().to(model.grid.table.device))
    states.append((error(model), _copied(model)))
    start_from_data(model, volume, cancelled)
    states.append((error(model), _copied(model)))
    model.load_state_dict(min(states, key=lambda state: state[0])[1])


def _copied(model: NeuralModel) -> dict[str, Tensor]:
    return {name: parameter.clone() for name, parameter in model.state_dict().items()}


def _carrying_level(model: NeuralModel) -> int | None:
    dense = [number for number, level in enumerate(model.grid.grid_levels) if level.dense]
    return dense[-1] if dense else None


def _carrier(model: NeuralModel, number: int) -> Tensor:
    """Return a view of the first feature of a level's vertices."""
    level = model.grid.grid_levels[number]
    return model.grid.table.detach()[level.first_row : level.first_row + level.size, 0]


def block_average(
    plane: Callable[[tuple[int]], NDArray[np.float32]],
    level: GridLevel,
    geometry: VolumeGeometry,
    cancelled: Callable[[], bool],
) -> NDArray[np.float32] | None:
    """Return the mean around each vertex of a grid level, [bscan, axial, lateral], of values at a volume's voxels.

    A voxel counts for the vertices of its cell as interpolation weights them, which is separable by axis. A vertex
    that no voxel reaches, where cells are finer than voxels, takes the mean of the vertices beside it.

    Args:
        plane: gives the values [axial, lateral] of the B-scan whose index it gets.
        level: the level.
        geometry: of the volume.
        cancelled: asked before every B-scan; True ends it with None.
    """
    bscans, axials, laterals = geometry.shape
    (lateral_scale, axial_scale, bscan_scale), (columns, rows, layers) = level.scale, level.vertices
    to_columns, to_rows, to_layers = (
        axis_averages(count, scale, vertices)
        for count, scale, vertices in (
            (laterals, lateral_scale, columns), (axials, axial_scale, rows), (bscans, bscan_scale, layers)
        )
    )  # fmt: skip
    planes = np.empty((bscans, rows * columns), np.float32)
    for bscan in range(bscans):
        if cancelled():
            return None
        across = (to_columns @ plane((bscan,)).T).T
        planes[bscan] = (to_rows @ across).ravel()
    return np.asarray(to_layers @ planes, np.float32).reshape(layers, rows, columns)


def axis_averages(count: int, scale: float, vertices: int) -> Any:
    """Return the sparse matrix [vertices, count] of the voxels' weights along one axis; its rows sum to one.

    Args:
        count: voxels along the axis.
        scale: cells of a level along it.
        vertices: of the level along it.
    """
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
