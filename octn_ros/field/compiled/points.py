"""Values and gradients of a neural field at scattered points, tile by tile."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Encoding, Perceptron, WayBack
from octn_ros.field.compiled.layers import run_backwards, run_network
from octn_ros.field.compiled.model import in_parts, way_back_of
from octn_ros.field.compiled.options import KERNEL, TILE
from octn_ros.field.compiled.walk import cell_of, table_row

# Tiles that a thread takes at a time: enough to be worth the handing over, few enough to share the work evenly.
_TILES = 64


def evaluate_points(
    encoding: Encoding, perceptron: Perceptron, points: NDArray[np.float32], *, gradients: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return intensities [N] and, if asked for, their exact gradients [N, 3] at canonical points [N, 3].

    Order of points and gradients: (lateral, axial, bscan). At a cell face the gradient is that of the cell on the far
    side; outside the cube it is zero along the clamped axes. Both are NaN at a point that is. Without `gradients` the
    second array is empty.
    Thread-safe; the answer does not depend on the number of threads.
    """
    count = len(points)
    values = np.empty(count, np.float32)
    gradient = np.empty((count if gradients else 0, 3), np.float32)
    back = way_back_of(perceptron)

    def part(start: int, stop: int) -> None:
        _part(points, start, stop, encoding, perceptron, back, gradients, values, gradient)

    in_parts(part, count, TILE * _TILES)
    nowhere = np.flatnonzero(np.isnan(points).any(axis=1))
    values[nowhere] = np.nan
    if gradients:
        gradient[nowhere] = np.nan
    return values, gradient


@njit(**KERNEL)
def _part(
    points: NDArray[np.float32],
    start: int,
    stop: int,
    encoding: Encoding,
    perceptron: Perceptron,
    back: WayBack,
    gradients: bool,
    values: NDArray[np.float32],
    gradient: NDArray[np.float32],
) -> None:
    neurons, inputs = perceptron.first.shape
    encoded = np.zeros((inputs, TILE), np.float32)
    # By unit coordinates along (bscan, axial, lateral).
    slopes = np.zeros((3, inputs if gradients else 0, TILE), np.float32)
    activations = np.empty((perceptron.more.shape[0] + 1, neurons, TILE), np.float32)
    passed = np.empty((2, neurons, TILE), np.float32)
    by_feature = np.empty((inputs, TILE), np.float32)
    answer = np.empty(TILE, np.float32)
    for tile in range(start, stop, TILE):
        size = min(TILE, stop - tile)
        for level in range(encoding.scale.shape[0]):
            for k in range(size):
                _encode_point(points[tile + k], level, encoding, k, encoded, slopes)
        run_network(perceptron, encoded, activations, answer)
        values[tile : tile + size] = answer[:size]
        if not gradients:
            continue
        run_backwards(perceptron, back, activations, passed, by_feature)
        for axis in range(3):
            for k in range(TILE):
                answer[k] = 0
            for i in range(inputs):
                for k in range(TILE):
                    answer[k] += by_feature[i, k] * slopes[axis, i, k]
            for k in range(size):
                # Half, since a canonical axis is two units long; and none where the point was clamped.
                inside = np.float32(0.5) if abs(points[tile + k, 2 - axis]) <= np.float32(1.0) else np.float32(0.0)
                gradient[tile + k, 2 - axis] = inside * answer[k]


@njit(**KERNEL)
def _encode_point(
    point: NDArray[np.float32],
    level: int,
    encoding: Encoding,
    k: int,
    encoded: NDArray[np.float32],
    slopes: NDArray[np.float32],
) -> None:
    """Write column `k` of the features, and of their slopes unless these are empty, for one level of one point."""
    scale, factors = encoding.scale[level], encoding.factors[level]
    first_row, mask = encoding.first_row[level], encoding.mask[level]
    cell_z, share_z, slope_z = cell_of(point[2], scale[0], encoding.smooth)
    cell_y, share_y, slope_y = cell_of(point[1], scale[1], encoding.smooth)
    cell_x, share_x, slope_x = cell_of(point[0], scale[2], encoding.smooth)
    features = encoding.table.shape[1]
    offset = level * features
    wanted = slopes.shape[1] > 0
    for f in range(features):
        encoded[offset + f, k] = 0
        if wanted:
            for axis in range(3):
                slopes[axis, offset + f, k] = 0
    for dz in range(2):
        a = (cell_z + dz) * factors[0]
        weight_z, change_z = (share_z, slope_z) if dz == 1 else (np.float32(1.0) - share_z, -slope_z)
        for dy in range(2):
            b = (cell_y + dy) * factors[1]
            weight_y, change_y = (share_y, slope_y) if dy == 1 else (np.float32(1.0) - share_y, -slope_y)
            for dx in range(2):
                c = (cell_x + dx) * factors[2]
                weight_x, change_x = (share_x, slope_x) if dx == 1 else (np.float32(1.0) - share_x, -slope_x)
                row = table_row(a, b, c, first_row, mask)
                for f in range(features):
                    feature = encoding.table[row, f]
                    encoded[offset + f, k] += weight_z * weight_y * weight_x * feature
                    if wanted:
                        slopes[0, offset + f, k] += change_z * weight_y * weight_x * feature
                        slopes[1, offset + f, k] += weight_z * change_y * weight_x * feature
                        slopes[2, offset + f, k] += weight_z * weight_y * change_x * feature
