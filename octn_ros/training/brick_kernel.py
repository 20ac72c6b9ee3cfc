"""Compiled passes over bricks of training samples: encode, perceptron, loss and the way back, then Adam.

A lane is a fixed share of the work: sums are kept apart by lane and added in a fixed order, so that a fit does not
depend on how many threads run the lanes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.layers import add_outer, gate, multiply, run_hidden, run_output
from octn_ros.field.compiled.options import BRICK, KERNEL, TILE
from octn_ros.field.compiled.walk import (
    MOST_VERTICES,
    blend_layer,
    blend_rows,
    find_rows,
    spread_layer,
    spread_rows,
    walk_axis,
)

# Table rows are dealt to lanes in runs of this many, so that no two threads write into one cache line.
_ROW_RUN = 16


@njit(**KERNEL)
def look_up(
    voxels: NDArray[Any],
    low: np.float32,
    gain: np.float32,
    cell: NDArray[np.int64],
    share: NDArray[np.float32],
    targets: NDArray[np.float32],
) -> None:
    """Write the intensities of bricks, interpolated trilinearly where they lie between voxels.

    Args:
        voxels: raw values [bscan, axial, lateral].
        low, gain: what makes them intensities; they are clipped to [0, 1].
        cell: voxel before each sample along (bscan, axial, lateral) [bricks, 3, BRICK].
        share: weight of the voxel after it, likewise; 0 at a voxel.
        targets: written: [bricks, BRICK^3].
    """
    last = np.array([voxels.shape[0] - 1, voxels.shape[1] - 1, voxels.shape[2] - 1])
    for n in range(cell.shape[0]):
        whole = not share[n].any()
        for z in range(BRICK):
            for y in range(BRICK):
                for x in range(BRICK):
                    a, b, c = cell[n, 0, z], cell[n, 1, y], cell[n, 2, x]
                    if whole:
                        value = _intensity(voxels[a, b, c], low, gain)
                    else:
                        value = np.float32(0.0)
                        for dz in range(2):
                            by_z = share[n, 0, z] if dz else np.float32(1.0) - share[n, 0, z]
                            for dy in range(2):
                                by_y = share[n, 1, y] if dy else np.float32(1.0) - share[n, 1, y]
                                for dx in range(2):
                                    by_x = share[n, 2, x] if dx else np.float32(1.0) - share[n, 2, x]
                                    corner = voxels[min(a + dz, last[0]), min(b + dy, last[1]), min(c + dx, last[2])]
                                    value += by_z * by_y * by_x * _intensity(corner, low, gain)
                    targets[n, (z * BRICK + y) * BRICK + x] = value


@njit(**KERNEL)
def _intensity(raw: Any, low: np.float32, gain: np.float32) -> np.float32:
    return min(max((np.float32(raw) - low) * gain, np.float32(0.0)), np.float32(1.0))


@njit(**KERNEL)
def pass_lane(
    lane: int,
    lanes: int,
    coordinates: NDArray[np.float32],
    weights: NDArray[np.float32],
    targets: NDArray[np.float32],
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
    first_back: NDArray[np.float32],
    more_back: NDArray[np.float32],
    capacity: int,
    touched_rows: NDArray[np.int64],
    row_gradients: NDArray[np.float32],
    touched: NDArray[np.int64],
    first_gradient: NDArray[np.float32],
    first_bias_gradient: NDArray[np.float32],
    more_gradient: NDArray[np.float32],
    more_bias_gradient: NDArray[np.float32],
    output_gradient: NDArray[np.float32],
    output_bias_gradient: NDArray[np.float32],
    squared_error: NDArray[np.float64],
) -> None:
    """Pass every `lanes`-th brick forward and back; gradients are of half the sum of squared errors.

    Args:
        coordinates: canonical, along (bscan, axial, lateral) [bricks, 3, BRICK].
        weights: 1 where a sample counts, 0 outside the volume, likewise; a sample's weight is the product.
        targets: intensities [bricks, BRICK^3].
        capacity: vertices that one brick can touch over all levels.
        touched_rows, row_gradients, touched: written: rows and gradients of each brick's vertices, from place
            `capacity * brick` on, and how many they are.
        first_gradient ... squared_error: added to at index `lane`.
    """
    levels, features = scale.shape[0], table.shape[1]
    inputs, neurons, others = first.shape[1], first.shape[0], more.shape[0]
    numbers = np.empty((3, MOST_VERTICES), np.int64)
    near = np.empty((levels, 3, BRICK), np.int64)
    share = np.empty((levels, 3, BRICK), np.float32)
    counts = np.empty((levels, 3), np.int64)
    rows = np.empty((MOST_VERTICES, MOST_VERTICES, MOST_VERTICES), np.int64)
    vertex = np.empty((features, MOST_VERTICES), np.float32)
    line = np.empty((MOST_VERTICES, features, BRICK), np.float32)
    layers = np.empty((levels, MOST_VERTICES, features, TILE), np.float32)
    by_layers = np.empty((levels, MOST_VERTICES, features, TILE), np.float32)
    encoded = np.zeros((inputs, TILE), np.float32)
    by_encoded = np.empty((inputs, TILE), np.float32)
    activations = np.empty((others + 1, neurons, TILE), np.float32)
    passed = np.empty((2, neurons, TILE), np.float32)
    error = np.empty(TILE, np.float32)
    for brick in range(lane, coordinates.shape[0], lanes):
        place = capacity * brick
        for level in range(levels):
            for axis in range(3):
                counts[level, axis] = walk_axis(
                    coordinates[brick, axis], scale[level, axis], smooth, numbers[axis], near[level, axis],
                    share[level, axis],
                )  # fmt: skip
            find_rows(numbers, counts[level], factors[level], first_row[level], mask[level], rows)
            blend_rows(table, rows, counts[level], near[level], share[level], vertex, line, layers[level])
            for z in range(counts[level, 0]):
                by_layers[level, z] = 0
                for y in range(counts[level, 1]):
                    for x in range(counts[level, 2]):
                        touched_rows[place] = rows[z, y, x]
                        place += 1
        touched[brick] = place - capacity * brick
        for k in range(BRICK):
            if weights[brick, 0, k] == 0:
                continue
            for level in range(levels):
                blend_layer(layers[level], near[level], share[level], k, encoded, level * features)
            run_hidden(first, first_bias, more, more_bias, encoded, activations)
            run_output(output, output_bias, activations[others], error)
            total, square = np.float32(0.0), np.float32(0.0)
            for y in range(BRICK):
                for x in range(BRICK):
                    i = y * BRICK + x
                    error[i] = (error[i] - targets[brick, k * TILE + i]) * weights[brick, 1, y] * weights[brick, 2, x]
                    total += error[i]
                    square += error[i] * error[i]
            output_bias_gradient[lane] += total
            squared_error[lane] += square
            now = 0
            for j in range(neurons):
                total = np.float32(0.0)
                for i in range(TILE):
                    total += error[i] * activations[others, j, i]
                    passed[now, j, i] = error[i] * output[j]
                output_gradient[lane, j] += total
            gate(activations[others], passed[now])
            for layer in range(others - 1, -1, -1):
                add_outer(passed[now], activations[layer], more_gradient[lane, layer], more_bias_gradient[lane, layer])
                multiply(more_back[layer], passed[now], passed[1 - now])
                now = 1 - now
                gate(activations[layer], passed[now])
            add_outer(passed[now], encoded, first_gradient[lane], first_bias_gradient[lane])
            multiply(first_back, passed[now], by_encoded)
            for level in range(levels):
                spread_layer(by_encoded, level * features, near[level], share[level], k, by_layers[level])
        place = capacity * brick
        for level in range(levels):
            spread_rows(
                by_layers[level], counts[level], near[level], share[level], vertex, line, row_gradients, place
            )  # fmt: skip
            place += counts[level, 0] * counts[level, 1] * counts[level, 2]


@njit(**KERNEL)
def sum_lane(
    lane: int,
    lanes: int,
    capacity: int,
    touched_rows: NDArray[np.int64],
    row_gradients: NDArray[np.float32],
    touched: NDArray[np.int64],
    stamp: NDArray[np.int32],
    step: int,
    gradient: NDArray[np.float32],
    distinct: NDArray[np.int64],
) -> int:
    """Sum the gradients of this lane's table rows over all bricks, in their order.

    Args:
        stamp: the step in which each row was last touched [rows]; brought up to date.
        gradient: written: gradient of each row touched in this step [rows, features].
        distinct: written: this lane's rows.

    Returns:
        How many rows this lane has touched.
    """
    count = 0
    features = gradient.shape[1]
    for brick in range(len(touched)):
        for place in range(capacity * brick, capacity * brick + touched[brick]):
            row = touched_rows[place]
            if (row // _ROW_RUN) % lanes != lane:
                continue
            if stamp[row] != step:
                stamp[row] = step
                distinct[count] = row
                count += 1
                for f in range(features):
                    gradient[row, f] = row_gradients[place, f]
            else:
                for f in range(features):
                    gradient[row, f] += row_gradients[place, f]
    return count


@njit(**KERNEL)
def adam_rows(
    rows: NDArray[np.int64],
    table: NDArray[np.float32],
    gradient: NDArray[np.float32],
    moments: NDArray[np.float32],
    factor: np.float32,
    rate: np.float32,
    beta1: np.float32,
    beta2: np.float32,
    correction1: np.float32,
    correction2: np.float32,
    epsilon: np.float32,
) -> None:
    """Do Adam's step on the given rows of the table alone; `moments` [rows, 2 * features] holds both averages."""
    features = table.shape[1]
    for row in rows:
        for f in range(features):
            g = factor * gradient[row, f]
            mean = beta1 * moments[row, f] + (np.float32(1.0) - beta1) * g
            square = beta2 * moments[row, features + f] + (np.float32(1.0) - beta2) * g * g
            moments[row, f] = mean
            moments[row, features + f] = square
            root = np.float32(math.sqrt(square * correction2))
            table[row, f] -= rate * mean * correction1 / (root + epsilon)
