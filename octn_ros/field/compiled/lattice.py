"""Whole lattices of a neural field, brick by brick."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Encoding, Perceptron
from octn_ros.field.compiled.layers import run_network
from octn_ros.field.compiled.model import workers
from octn_ros.field.compiled.options import BRICK, KERNEL, LAYER, TILE
from octn_ros.field.compiled.walk import blend_layer, new_walk, walk_level


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

    def slab(first: int) -> None:
        _slab(bscan, axial, lateral, first, encoding, perceptron, answer)

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
    encoding: Encoding,
    perceptron: Perceptron,
    answer: NDArray[np.float32],
) -> None:
    levels, features = encoding.scale.shape[0], encoding.table.shape[1]
    neurons, inputs = perceptron.first.shape
    coordinates = np.empty((3, BRICK), np.float32)
    walk = new_walk(levels, features)
    layers = min(BRICK, len(bscan) - first_bscan)
    # A lone layer does not pay for a tile of several.
    tile = LAYER * min(layers, TILE // LAYER)
    encoded = np.zeros((inputs, tile), np.float32)
    activations = np.empty((perceptron.more.shape[0] + 1, neurons, tile), np.float32)
    values = np.empty(tile, np.float32)
    for k in range(BRICK):
        coordinates[0, k] = bscan[min(first_bscan + k, len(bscan) - 1)]
    for first_axial in range(0, len(axial), BRICK):
        for k in range(BRICK):
            coordinates[1, k] = axial[min(first_axial + k, len(axial) - 1)]
        for first_lateral in range(0, len(lateral), BRICK):
            for k in range(BRICK):
                coordinates[2, k] = lateral[min(first_lateral + k, len(lateral) - 1)]
            for level in range(levels):
                walk_level(level, coordinates, encoding, walk)
            for k in range(0, layers, tile // LAYER):
                together = range(k, min(k + tile // LAYER, layers))
                for layer in together:
                    blend_layer(layer, walk, encoded, (layer - k) * LAYER)
                run_network(perceptron, encoded, activations, values)
                for layer in together:
                    for y in range(min(BRICK, len(axial) - first_axial)):
                        place = (layer - k) * LAYER + y * BRICK
                        for x in range(min(BRICK, len(lateral) - first_lateral)):
                            answer[first_bscan + layer, first_axial + y, first_lateral + x] = values[place + x]
