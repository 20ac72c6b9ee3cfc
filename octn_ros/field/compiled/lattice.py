"""Whole lattices of a neural field, brick by brick."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.layers import run_hidden, run_output
from octn_ros.field.compiled.model import Encoding, Perceptron, workers
from octn_ros.field.compiled.options import BRICK, KERNEL, TILE
from octn_ros.field.compiled.walk import MOST_VERTICES, blend_layer, blend_rows, find_rows, walk_axis


def evaluate_lattice(
    encoding: Encoding,
    perceptron: Perceptron,
    lateral: NDArray[np.float32],
    axial: NDArray[np.float32],
    bscan: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors.

    The threads share the work by slabs of B-scans; the answer does not depend on their number. Thread-safe.
    """
    answer = np.empty((len(bscan), len(axial), len(lateral)), np.float32)
    inputs = perceptron.first.shape[1]

    def slab(first: int) -> None:
        _slab(
            bscan, axial, lateral, first, *encoding.kernel_arguments, *perceptron.kernel_arguments, inputs, answer
        )  # fmt: skip

    list(workers().map(slab, range(0, len(bscan), BRICK)))
    answer[np.isnan(bscan)] = np.nan
    answer[:, np.isnan(axial)] = np.nan
    answer[:, :, np.isnan(lateral)] = np.nan
    return answer


@njit(**KERNEL)
def _slab(
    bscan: NDArray[np.float32],
    axial: NDArray[np.float32],
    lateral: NDArray[np.float32],
    first_bscan: int,
    table: NDArray[np.float32],
    scale: NDArray[np.float32],
    factors: NDArray[np.int64],
    first_row: NDArray[np.int64],
    mask: NDArray[np.int64],
    smooth: bool,
    first: NDArray[np.float32],
    first_bias: NDArray[np.float32],
    more: NDArray[np.float32],
    more_bias: NDArray[np.float32],
    output: NDArray[np.float32],
    output_bias: np.float32,
    inputs: int,
    answer: NDArray[np.float32],
) -> None:
    levels, features = scale.shape[0], table.shape[1]
    neurons = first.shape[0]
    coordinates = np.empty((3, BRICK), np.float32)
    numbers = np.empty((3, MOST_VERTICES), np.int64)
    near = np.empty((levels, 3, BRICK), np.int64)
    share = np.empty((levels, 3, BRICK), np.float32)
    counts = np.empty(3, np.int64)
    rows = np.empty((MOST_VERTICES, MOST_VERTICES, MOST_VERTICES), np.int64)
    vertex = np.empty((features, MOST_VERTICES), np.float32)
    line = np.empty((MOST_VERTICES, features, BRICK), np.float32)
    layers = np.empty((levels, MOST_VERTICES, features, TILE), np.float32)
    encoded = np.zeros((inputs, TILE), np.float32)
    activations = np.empty((more.shape[0] + 1, neurons, TILE), np.float32)
    values = np.empty(TILE, np.float32)
    last_bscan = min(first_bscan + BRICK, len(bscan))
    for k in range(BRICK):
        coordinates[0, k] = bscan[min(first_bscan + k, len(bscan) - 1)]
    for first_axial in range(0, len(axial), BRICK):
        for k in range(BRICK):
            coordinates[1, k] = axial[min(first_axial + k, len(axial) - 1)]
        for first_lateral in range(0, len(lateral), BRICK):
            for k in range(BRICK):
                coordinates[2, k] = lateral[min(first_lateral + k, len(lateral) - 1)]
            for level in range(levels):
                for axis in range(3):
                    counts[axis] = walk_axis(
                        coordinates[axis], scale[level, axis], smooth, numbers[axis], near[level, axis],
                        share[level, axis],
                    )  # fmt: skip
                find_rows(numbers, counts, factors[level], first_row[level], mask[level], rows)
                blend_rows(table, rows, counts, near[level], share[level], vertex, line, layers[level])
            for k in range(last_bscan - first_bscan):
                for level in range(levels):
                    blend_layer(layers[level], near[level], share[level], k, encoded, level * features)
                run_hidden(first, first_bias, more, more_bias, encoded, activations)
                run_output(output, output_bias, activations[more.shape[0]], values)
                for y in range(min(BRICK, len(axial) - first_axial)):
                    for x in range(min(BRICK, len(lateral) - first_lateral)):
                        answer[first_bscan + k, first_axial + y, first_lateral + x] = values[y * BRICK + x]
