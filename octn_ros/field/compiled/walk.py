"""The walk of one brick of lattice points through one level of a hash grid, and back.

Points of a brick share vertices: each vertex is read once and blended axis by axis, lateral first. The way back sums
the gradient of each vertex over the brick before it touches any table.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Encoding
from octn_ros.field.compiled.options import BRICK, KERNEL, LAYER

# Vertices that the points of a brick can need along one axis: two each, if none is shared.
MOST_VERTICES = 2 * BRICK


@njit(**KERNEL)
def cell_of(coordinate: np.float32, scale: np.float32, smooth: bool) -> tuple[int, np.float32, np.float32]:
    """Return the cell of a canonical coordinate held in [-1, 1], the share of its far vertex, and that share's slope
    per unit. NaN counts as -1.
    """
    held = np.float32(-1.0)
    if coordinate > held:
        held = min(coordinate, np.float32(1.0))
    position = (held + np.float32(1.0)) * np.float32(0.5) * scale + np.float32(0.5)
    cell = np.int64(math.floor(position))
    share = position - np.float32(cell)
    slope = scale
    if smooth:
        slope = scale * np.float32(6.0) * share * (np.float32(1.0) - share)
        share = share * share * (np.float32(3.0) - np.float32(2.0) * share)
    return cell, share, slope


@njit(**KERNEL)
def table_row(first: int, second: int, third: int, first_row: int, mask: int) -> int:
    """Return the table row of a vertex from its factored numbers along the three axes; mask -1 for a dense level."""
    return first_row + (first + second + third if mask < 0 else (first ^ second ^ third) & mask)


@njit(**KERNEL)
def walk_axis(
    coordinates: NDArray[np.float32],
    scale: np.float32,
    smooth: bool,
    numbers: NDArray[np.int64],
    near: NDArray[np.int64],
    share: NDArray[np.float32],
) -> int:
    """Find the distinct vertices along one axis and each point's place between two of them.

    Args:
        coordinates: canonical, [BRICK], in any order.
        scale: cells per unit length.
        smooth: whether shares follow the smoothstep instead of the line.
        numbers: written: vertex numbers [MOST_VERTICES].
        near: written: index into `numbers` of the vertex before each point [BRICK]; the one after it is the next.
        share: written: weight of the vertex after [BRICK].

    Returns:
        How many vertices there are.
    """
    count = 0
    for k in range(BRICK):
        cell, share[k], _ = cell_of(coordinates[k], scale, smooth)
        if count >= 2 and numbers[count - 2] == cell:
            near[k] = count - 2
        elif count >= 1 and numbers[count - 1] == cell:
            numbers[count] = cell + 1
            near[k] = count - 1
            count += 1
        else:
            numbers[count] = cell
            numbers[count + 1] = cell + 1
            near[k] = count
            count += 2
    return count


class Walk(NamedTuple):
    """Where a brick's points lie between vertices, and its vertices blended so far.

    Attributes:
        counts: vertices of each level along (bscan, axial, lateral) [levels, 3].
        near: index of the vertex before each point, likewise [levels, 3, BRICK].
        share: weight of the vertex after it [levels, 3, BRICK].
        lateral: weight of each lateral vertex for each point, most of them 0 [levels, MOST_VERTICES, BRICK].
        layers: vertices blended along the lateral and axial axes [levels, bscan vertex, features, LAYER], a point's
            place in its layer being axial * BRICK + lateral.
        numbers: of the vertices of the level walked last [3, MOST_VERTICES].
        rows: their table rows [bscan, axial, lateral].
        line: scratch [MOST_VERTICES, features, BRICK].
    """

    counts: NDArray[np.int64]
    near: NDArray[np.int64]
    share: NDArray[np.float32]
    lateral: NDArray[np.float32]
    layers: NDArray[np.float32]
    numbers: NDArray[np.int64]
    rows: NDArray[np.int64]
    line: NDArray[np.float32]


@njit(**KERNEL)
def new_walk(levels: int, features: int) -> Walk:
    """Return a walk through no brick yet."""
    return Walk(
        np.empty((levels, 3), np.int64),
        np.empty((levels, 3, BRICK), np.int64),
        np.empty((levels, 3, BRICK), np.float32),
        np.empty((levels, MOST_VERTICES, BRICK), np.float32),
        np.empty((levels, MOST_VERTICES, features, LAYER), np.float32),
        np.empty((3, MOST_VERTICES), np.int64),
        np.empty((MOST_VERTICES, MOST_VERTICES, MOST_VERTICES), np.int64),
        np.empty((MOST_VERTICES, features, BRICK), np.float32),
    )


@njit(**KERNEL)
def walk_level(level: int, coordinates: NDArray[np.float32], encoding: Encoding, walk: Walk) -> None:
    """Walk one level of the brick at canonical coordinates [3, BRICK] along (bscan, axial, lateral)."""
    for axis in range(3):
        walk.counts[level, axis] = walk_axis(
            coordinates[axis],
            encoding.scale[level, axis],
            encoding.smooth,
            walk.numbers[axis],
            walk.near[level, axis],
            walk.share[level, axis],
        )
    lateral = walk.lateral[level]
    lateral[: walk.counts[level, 2]] = 0
    for k in range(BRICK):
        i = walk.near[level, 2, k]
        lateral[i, k] = np.float32(1.0) - walk.share[level, 2, k]
        lateral[i + 1, k] = walk.share[level, 2, k]
    _find_rows(level, encoding, walk)
    _blend_rows(level, encoding.table, walk)


@njit(**KERNEL)
def _find_rows(level: int, encoding: Encoding, walk: Walk) -> None:
    """Write the table rows of a brick's vertices."""
    numbers, counts, factors = walk.numbers, walk.counts[level], encoding.factors[level]
    first_row, mask = encoding.first_row[level], encoding.mask[level]
    for z in range(counts[0]):
        a = numbers[0, z] * factors[0]
        for y in range(counts[1]):
            b = numbers[1, y] * factors[1]
            for x in range(counts[2]):
                c = numbers[2, x] * factors[2]
                walk.rows[z, y, x] = table_row(a, b, c, first_row, mask)


@njit(**KERNEL)
def _blend_rows(level: int, table: NDArray[np.float32], walk: Walk) -> None:
    """Blend vertices along the lateral and axial axes."""
    counts, near, share, lateral = walk.counts[level], walk.near[level], walk.share[level], walk.lateral[level]
    line, layers = walk.line, walk.layers[level]
    features = table.shape[1]
    for z in range(counts[0]):
        for y in range(counts[1]):
            for f in range(features):
                at = line[y, f]
                for k in range(BRICK):
                    at[k] = 0
                for x in range(counts[2]):
                    feature, weight = table[walk.rows[z, y, x], f], lateral[x]
                    for k in range(BRICK):
                        at[k] += feature * weight[k]
        for k in range(BRICK):
            i = near[1, k]
            weight = share[1, k]
            for f in range(features):
                for x in range(BRICK):
                    before = line[i, f, x]
                    layers[z, f, k * BRICK + x] = before + (line[i + 1, f, x] - before) * weight


@njit(**KERNEL)
def blend_layer(k: int, walk: Walk, encoded: NDArray[np.float32], start: int) -> None:
    """Blend along the bscan axis: the features [inputs, start : start + LAYER] of layer `k` of a brick, all levels."""
    features = walk.layers.shape[2]
    for level in range(walk.layers.shape[0]):
        i = walk.near[level, 0, k]
        weight = walk.share[level, 0, k]
        for f in range(features):
            before, after = walk.layers[level, i, f], walk.layers[level, i + 1, f]
            into = encoded[level * features + f, start : start + LAYER]
            for x in range(LAYER):
                into[x] = before[x] + (after[x] - before[x]) * weight


@njit(**KERNEL)
def spread_layer(k: int, gradient: NDArray[np.float32], start: int, walk: Walk, by_layers: NDArray[np.float32]) -> None:
    """Add the gradient [inputs, start : start + LAYER] of one layer's features to that of the walk's layers: the
    adjoint of `blend_layer`.
    """
    features = walk.layers.shape[2]
    for level in range(walk.layers.shape[0]):
        i = walk.near[level, 0, k]
        weight = walk.share[level, 0, k]
        for f in range(features):
            before, after = by_layers[level, i, f], by_layers[level, i + 1, f]
            whole = gradient[level * features + f, start : start + LAYER]
            for x in range(LAYER):
                share = whole[x] * weight
                after[x] += share
                before[x] += whole[x] - share


@njit(**KERNEL)
def spread_rows(
    level: int, walk: Walk, by_layers: NDArray[np.float32], gradient: NDArray[np.float32], start: int
) -> None:
    """Write the gradient of each vertex of a level into `gradient` [start + vertex, feature], from that of its layers
    [bscan vertex, feature, LAYER]: the adjoint of what `walk_level` blends.
    """
    counts, near, share, lateral = walk.counts[level], walk.near[level], walk.share[level], walk.lateral[level]
    line, layers = walk.line, by_layers
    features = layers.shape[1]
    place = start
    for z in range(counts[0]):
        for y in range(counts[1]):
            for f in range(features):
                for x in range(BRICK):
                    line[y, f, x] = 0
        for k in range(BRICK):
            i = near[1, k]
            weight = share[1, k]
            for f in range(features):
                for x in range(BRICK):
                    whole = layers[z, f, k * BRICK + x]
                    after = whole * weight
                    line[i + 1, f, x] += after
                    line[i, f, x] += whole - after
        for y in range(counts[1]):
            for x in range(counts[2]):
                weights = lateral[x]
                for f in range(features):
                    at = line[y, f]
                    total = np.float32(0.0)
                    for k in range(BRICK):
                        total += at[k] * weights[k]
                    gradient[place, f] = total
                place += 1
