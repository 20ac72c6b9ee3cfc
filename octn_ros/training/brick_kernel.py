"""Compiled passes over bricks of training samples: encode, perceptron, loss and the way back, then Adam.

A lane is a fixed share of the work: sums are kept apart by lane and added in a fixed order, so that a fit does not
depend on how many threads run the lanes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Encoding, Perceptron, WayBack
from octn_ros.field.compiled.layers import add_outer, enter_backwards, gate, multiply, run_network
from octn_ros.field.compiled.options import BRICK, KERNEL, LAYER, TILE
from octn_ros.field.compiled.walk import blend_layer, new_walk, spread_layer, spread_rows, walk_level

# Table rows are dealt to lanes in runs of this many, so that no two threads write into one cache line.
_ROW_RUN = 16


class Samples(NamedTuple):
    """Samples in bricks of BRICK^3 lattice points; axes are (bscan, axial, lateral).

    Attributes:
        coordinates: canonical [bricks, 3, BRICK].
        weights: 1 where a sample counts, 0 outside the volume, likewise; a sample's weight is the product.
        cell: voxel at or before each sample, likewise.
        share: how far it lies beyond that voxel, in voxels, likewise.
    """

    coordinates: NDArray[np.float32]
    weights: NDArray[np.float32]
    cell: NDArray[np.int64]
    share: NDArray[np.float32]


class Touched(NamedTuple):
    """The table rows that a step touches, brick by brick, and their gradients.

    Attributes:
        rows: table rows [bricks, vertices]; a brick fills as many as `counts` says.
        gradients: of each [bricks, vertices, features].
        counts: how many they are [bricks].
        order: places of `rows` sorted by the lane that the row is dealt to [bricks, vertices].
        first: where each lane begins in `order`, and where the last one ends [bricks, lanes + 1].
    """

    rows: NDArray[np.int64]
    gradients: NDArray[np.float32]
    counts: NDArray[np.int64]
    order: NDArray[np.int32]
    first: NDArray[np.int64]


@njit(**KERNEL)
def look_up(
    lane: int,
    lanes: int,
    voxels: NDArray[Any],
    low: np.float32,
    gain: np.float32,
    samples: Samples,
    targets: NDArray[np.float32],
) -> None:
    """Write the intensities of every `lanes`-th brick, interpolated trilinearly where they lie between voxels.

    Args:
        voxels: raw values [bscan, axial, lateral].
        low, gain: what makes them intensities; they are clipped to [0, 1].
        samples: where to look.
        targets: written: [bricks, BRICK^3].
    """
    cell, share = samples.cell, samples.share
    last = np.array([voxels.shape[0] - 1, voxels.shape[1] - 1, voxels.shape[2] - 1])
    for n in range(lane, cell.shape[0], lanes):
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
    samples: Samples,
    targets: NDArray[np.float32],
    encoding: Encoding,
    perceptron: Perceptron,
    back: WayBack,
    touched: Touched,
    sums: Perceptron,
    squared_error: NDArray[np.float64],
) -> None:
    """Pass every `lanes`-th brick forward and back; gradients are of half the sum of squared errors.

    Args:
        samples, targets: what is fitted; targets [bricks, BRICK^3].
        touched: written.
        sums: gradients of the perceptron, added to at index `lane` of their first axis.
        squared_error: likewise.
    """
    levels, features = encoding.scale.shape[0], encoding.table.shape[1]
    neurons, inputs = perceptron.first.shape
    last = perceptron.more.shape[0]
    walk = new_walk(levels, features)
    by_layers = np.empty(walk.layers.shape, np.float32)
    encoded = np.zeros((inputs, TILE), np.float32)
    by_encoded = np.empty((inputs, TILE), np.float32)
    activations = np.empty((last + 1, neurons, TILE), np.float32)
    passed = np.empty((2, neurons, TILE), np.float32)
    error = np.empty(TILE, np.float32)
    for brick in range(lane, samples.coordinates.shape[0], lanes):
        weights = samples.weights[brick]
        count = 0
        for level in range(levels):
            walk_level(level, samples.coordinates[brick], encoding, walk)
            counts = walk.counts[level]
            for z in range(counts[0]):
                by_layers[level, z] = 0
                for y in range(counts[1]):
                    for x in range(counts[2]):
                        touched.rows[brick, count] = walk.rows[z, y, x]
                        count += 1
        touched.counts[brick] = count
        _deal(touched.rows[brick, :count], lanes, touched.order[brick], touched.first[brick])
        for k in range(0, BRICK, TILE // LAYER):
            layers = range(k, k + TILE // LAYER)
            for layer in layers:
                blend_layer(layer, walk, encoded, (layer - k) * LAYER)
            run_network(perceptron, encoded, activations, error)
            total, square = np.float32(0.0), np.float32(0.0)
            for layer in layers:
                for y in range(BRICK):
                    first = y * BRICK
                    here = error[(layer - k) * LAYER + first : (layer - k) * LAYER + first + BRICK]
                    wanted = targets[brick, layer * LAYER + first : layer * LAYER + first + BRICK]
                    weight = weights[0, layer] * weights[1, y]
                    for x in range(BRICK):
                        here[x] = (here[x] - wanted[x]) * (weight * weights[2, x])
                        total += here[x]
                        square += here[x] * here[x]
            sums.output_bias[lane] += total
            squared_error[lane] += square
            now = 0
            enter_backwards(perceptron.output, error, activations[last], passed[now], sums.output[lane])
            for layer in range(last - 1, -1, -1):
                add_outer(passed[now], activations[layer], sums.more[lane, layer], sums.more_bias[lane, layer])
                multiply(back.more[layer], passed[now], passed[1 - now])
                now = 1 - now
                gate(activations[layer], passed[now])
            add_outer(passed[now], encoded, sums.first[lane], sums.first_bias[lane])
            multiply(back.first, passed[now], by_encoded)
            for layer in layers:
                spread_layer(layer, by_encoded, (layer - k) * LAYER, walk, by_layers)
        place = 0
        for level in range(levels):
            spread_rows(level, walk, by_layers[level], touched.gradients[brick], place)
            place += walk.counts[level].prod()


@njit(**KERNEL)
def _deal(rows: NDArray[np.int64], lanes: int, order: NDArray[np.int32], first: NDArray[np.int64]) -> None:
    """Sort the places of `rows` by lane: `first` [lanes + 1] of each, and the `order`, which keeps that of `rows`."""
    first[:] = 0
    for row in rows:
        first[(row // _ROW_RUN) % lanes + 1] += 1
    for lane in range(lanes):
        first[lane + 1] += first[lane]
    filled = first.copy()
    for place in range(len(rows)):
        lane = (rows[place] // _ROW_RUN) % lanes
        order[filled[lane]] = place
        filled[lane] += 1


@njit(**KERNEL)
def sum_lane(
    lane: int,
    touched: Touched,
    place_of: NDArray[np.int32],
    gradient: NDArray[np.float32],
    distinct: NDArray[np.int64],
) -> int:
    """Sum the gradients of this lane's table rows over all bricks, in their order.

    Args:
        touched: what the bricks have touched.
        place_of: for each row its place in the sums of the step that touched it last [rows]; brought up to date. It
            holds for this step where `distinct` has the row at that place, so nothing is cleared between steps.
        gradient: written: the sums of this lane's rows [rows of the lane, features].
        distinct: written: this lane's rows.

    Returns:
        How many rows this lane has touched.
    """
    count = 0
    features = gradient.shape[1]
    for brick in range(len(touched.counts)):
        for sorted_place in range(touched.first[brick, lane], touched.first[brick, lane + 1]):
            place = touched.order[brick, sorted_place]
            row = touched.rows[brick, place]
            known = place_of[row]
            if known >= count or distinct[known] != row:
                place_of[row] = count
                distinct[count] = row
                for f in range(features):
                    gradient[count, f] = touched.gradients[brick, place, f]
                count += 1
            else:
                for f in range(features):
                    gradient[known, f] += touched.gradients[brick, place, f]
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
    """Do Adam's step on the given rows of the table alone, whose gradients are `factor` times those given in the same
    order; `moments` [table rows, 2 * features] holds both averages.
    """
    features = table.shape[1]
    for place in range(len(rows)):
        row = rows[place]
        for f in range(features):
            g = factor * gradient[place, f]
            mean = beta1 * moments[row, f] + (np.float32(1.0) - beta1) * g
            square = beta2 * moments[row, features + f] + (np.float32(1.0) - beta2) * g * g
            moments[row, f] = mean
            moments[row, features + f] = square
            root = np.float32(math.sqrt(square * correction2))
            table[row, f] -= rate * mean * correction1 / (root + epsilon)
