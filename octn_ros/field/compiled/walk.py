"""The walk of one brick of lattice points through one level of a hash grid, and back.

Points of a brick share vertices: each vertex is read once and blended axis by axis, lateral first. The way back sums
the gradient of each vertex over the brick before it touches any table.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.options import BRICK, KERNEL

# Vertices that the points of a brick can need along one axis: two each, if none is shared.
MOST_VERTICES = 2 * BRICK


@njit(**KERNEL)
def position_of(coordinate: np.float32, scale: np.float32) -> np.float32:
    """Return the position in cells, half a cell in, of a canonical coordinate held in [-1, 1]; NaN counts as -1."""
    held = np.float32(-1.0)
    if coordinate > held:
        held = min(coordinate, np.float32(1.0))
    return (held + np.float32(1.0)) * np.float32(0.5) * scale + np.float32(0.5)


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
        position = position_of(coordinates[k], scale)
        cell = np.int64(math.floor(position))
        weight = position - np.float32(cell)
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
        if smooth:
            weight = weight * weight * (np.float32(3.0) - np.float32(2.0) * weight)
        share[k] = weight
    return count


@njit(**KERNEL)
def find_rows(
    numbers: NDArray[np.int64],
    counts: NDArray[np.int64],
    factors: NDArray[np.int64],
    first_row: int,
    mask: int,
    rows: NDArray[np.int64],
) -> None:
    """Write the table rows [bscan, axial, lateral] of the vertices of a brick; `mask` is -1 for a dense level."""
    for z in range(counts[0]):
        a = numbers[0, z] * factors[0]
        for y in range(counts[1]):
            b = numbers[1, y] * factors[1]
            for x in range(counts[2]):
                c = numbers[2, x] * factors[2]
                rows[z, y, x] = first_row + (a + b + c if mask < 0 else (a ^ b ^ c) & mask)


@njit(**KERNEL)
def blend_rows(
    table: NDArray[np.float32],
    rows: NDArray[np.int64],
    counts: NDArray[np.int64],
    near: NDArray[np.int64],
    share: NDArray[np.float32],
    vertex: NDArray[np.float32],
    line: NDArray[np.float32],
    layers: NDArray[np.float32],
) -> None:
    """Blend vertices along the lateral and axial axes: layers [bscan vertex, feature, axial * BRICK + lateral].

    `vertex` [feature, MOST_VERTICES] and `line` [MOST_VERTICES, feature, BRICK] are scratch.
    """
    features = table.shape[1]
    for z in range(counts[0]):
        for y in range(counts[1]):
            for x in range(counts[2]):
                row = rows[z, y, x]
                for f in range(features):
                    vertex[f, x] = table[row, f]
            for f in range(features):
                for k in range(BRICK):
                    i = near[2, k]
                    before = vertex[f, i]
                    line[y, f, k] = before + (vertex[f, i + 1] - before) * share[2, k]
        for k in range(BRICK):
            i = near[1, k]
            weight = share[1, k]
            for f in range(features):
                for x in range(BRICK):
                    before = line[i, f, x]
                    layers[z, f, k * BRICK + x] = before + (line[i + 1, f, x] - before) * weight


@njit(**KERNEL)
def blend_layer(
    layers: NDArray[np.float32],
    near: NDArray[np.int64],
    share: NDArray[np.float32],
    k: int,
    features: NDArray[np.float32],
    offset: int,
) -> None:
    """Blend along the bscan axis: rows `offset` and on of `features` [width, TILE] for layer `k` of the brick."""
    i = near[0, k]
    weight = share[0, k]
    for f in range(layers.shape[1]):
        for x in range(BRICK * BRICK):
            before = layers[i, f, x]
            features[offset + f, x] = before + (layers[i + 1, f, x] - before) * weight


@njit(**KERNEL)
def spread_layer(
    gradient: NDArray[np.float32],
    offset: int,
    near: NDArray[np.int64],
    share: NDArray[np.float32],
    k: int,
    layers: NDArray[np.float32],
) -> None:
    """Add the gradient of one layer's features to that of `layers`: the adjoint of `blend_layer`."""
    i = near[0, k]
    weight = share[0, k]
    for f in range(layers.shape[1]):
        for x in range(BRICK * BRICK):
            after = gradient[offset + f, x] * weight
            layers[i + 1, f, x] += after
            layers[i, f, x] += gradient[offset + f, x] - after


@njit(**KERNEL)
def spread_rows(
    layers: NDArray[np.float32],
    counts: NDArray[np.int64],
    near: NDArray[np.int64],
    share: NDArray[np.float32],
    vertex: NDArray[np.float32],
    line: NDArray[np.float32],
    gradient: NDArray[np.float32],
    start: int,
) -> None:
    """Write the gradient of each vertex of a brick into `gradient` [start + vertex, feature]: `blend_rows`' adjoint."""
    features = layers.shape[1]
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
            for f in range(features):
                for x in range(counts[2]):
                    vertex[f, x] = 0
                for k in range(BRICK):
                    i = near[2, k]
                    whole = line[y, f, k]
                    after = whole * share[2, k]
                    vertex[f, i + 1] += after
                    vertex[f, i] += whole - after
            place = start + (z * counts[1] + y) * counts[2]
            for x in range(counts[2]):
                for f in range(features):
                    gradient[place + x, f] = vertex[f, x]
