"""Values and slopes of a neural field along the axial axis: what a line's depths share is blended once."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Encoding, Perceptron, WayBack
from octn_ros.field.compiled.layers import run_backwards, run_network
from octn_ros.field.compiled.model import in_parts, way_back_of
from octn_ros.field.compiled.options import KERNEL, TILE
from octn_ros.field.compiled.walk import cell_of, table_row

# Points that a thread takes at a time: enough to be worth the handing over, few enough to share the work evenly.
_POINTS = 64 * TILE


def evaluate_lines(
    encoding: Encoding,
    perceptron: Perceptron,
    lateral: NDArray[np.float32],
    bscan: NDArray[np.float32],
    axial: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return intensities [N, K] at canonical depths [N, K] of the axial lines at lateral [N], bscan [N].

    The vertices that a line passes are blended across once, whatever the number of depths. NaN where a coordinate is.
    Thread-safe; the answer does not depend on the number of threads.
    """
    lines, depths = axial.shape
    values = np.empty((lines, depths), np.float32)
    if values.size == 0:
        return values
    # Any cell that a depth can lie in has two vertices below this.
    vertices = int(np.floor(encoding.scale[:, 1].max() + np.float32(0.5))) + 2

    def part(start: int, stop: int) -> None:
        _lines(lateral, bscan, axial, start, stop, vertices, encoding, perceptron, values)

    in_parts(part, lines, max(1, _POINTS // depths))
    values[np.isnan(lateral) | np.isnan(bscan)] = np.nan
    values[np.isnan(axial)] = np.nan
    return values


def evaluate_axial_slopes(
    encoding: Encoding,
    perceptron: Perceptron,
    lateral: NDArray[np.float32],
    axial: NDArray[np.float32],
    bscan: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N] each.

    As `evaluate_points` does with gradients, without those along the other axes. Thread-safe.
    """
    count = len(axial)
    values, slopes = np.empty(count, np.float32), np.empty(count, np.float32)
    back = way_back_of(perceptron)

    def part(start: int, stop: int) -> None:
        _axial_slopes(lateral, axial, bscan, start, stop, encoding, perceptron, back, values, slopes)

    in_parts(part, count, _POINTS)
    nowhere = np.isnan(lateral) | np.isnan(axial) | np.isnan(bscan)
    values[nowhere] = np.nan
    slopes[nowhere] = np.nan
    return values, slopes


@njit(**KERNEL)
def _lines(
    lateral: NDArray[np.float32],
    bscan: NDArray[np.float32],
    axial: NDArray[np.float32],
    start: int,
    stop: int,
    vertices: int,
    encoding: Encoding,
    perceptron: Perceptron,
    values: NDArray[np.float32],
) -> None:
    depths = axial.shape[1]
    levels, features = encoding.scale.shape[0], encoding.table.shape[1]
    neurons, inputs = perceptron.first.shape
    cells, shares = np.empty((levels, depths), np.int64), np.empty((levels, depths), np.float32)
    passed = np.empty((vertices, features), np.float32)
    encoded = np.zeros((inputs, TILE), np.float32)
    line = np.empty((levels * features, depths), np.float32)
    activations = np.empty((perceptron.more.shape[0] + 1, neurons, TILE), np.float32)
    answer = np.empty(TILE, np.float32)
    flat = values.reshape(-1)
    held = 0
    for n in range(start, stop):
        for level in range(levels):
            low, high = vertices, 0
            scale = encoding.scale[level, 1]
            for k in range(depths):
                cell, share, _ = cell_of(axial[n, k], scale, encoding.smooth)
                cells[level, k] = cell
                shares[level, k] = share
                low, high = min(low, cell), max(high, cell)
            if high - low < 2 * depths:
                _blend_across(lateral[n], bscan[n], low, high + 2, level, encoding, passed)
            for k in range(depths):
                first = cells[level, k] - low
                if high - low >= 2 * depths:
                    # Depths so far apart that hardly two share a vertex.
                    _blend_across(lateral[n], bscan[n], low + first, low + first + 2, level, encoding, passed)
                    first = 0
                share = shares[level, k]
                for f in range(features):
                    before = passed[first, f]
                    line[level * features + f, k] = before + (passed[first + 1, f] - before) * share
        for k in range(depths):
            for i in range(levels * features):
                encoded[i, held] = line[i, k]
            held += 1
            if held == TILE or (n == stop - 1 and k == depths - 1):
                run_network(perceptron, encoded, activations, answer)
                end = n * depths + k + 1
                flat[end - held : end] = answer[:held]
                held = 0


@njit(**KERNEL)
def _axial_slopes(
    lateral: NDArray[np.float32],
    axial: NDArray[np.float32],
    bscan: NDArray[np.float32],
    start: int,
    stop: int,
    encoding: Encoding,
    perceptron: Perceptron,
    back: WayBack,
    values: NDArray[np.float32],
    slopes: NDArray[np.float32],
) -> None:
    levels, features = encoding.scale.shape[0], encoding.table.shape[1]
    neurons, inputs = perceptron.first.shape
    encoded, tangents = np.zeros((inputs, TILE), np.float32), np.zeros((inputs, TILE), np.float32)
    activations = np.empty((perceptron.more.shape[0] + 1, neurons, TILE), np.float32)
    scratch, by_feature = np.empty((2, neurons, TILE), np.float32), np.empty((inputs, TILE), np.float32)
    answer, faces = np.empty(TILE, np.float32), np.empty((2, features), np.float32)
    for tile in range(start, stop, TILE):
        size = min(TILE, stop - tile)
        for level in range(levels):
            for k in range(size):
                n = tile + k
                cell, share, slope = cell_of(axial[n], encoding.scale[level, 1], encoding.smooth)
                _blend_across(lateral[n], bscan[n], cell, cell + 2, level, encoding, faces)
                for f in range(features):
                    rise = faces[1, f] - faces[0, f]
                    encoded[level * features + f, k] = faces[0, f] + rise * share
                    tangents[level * features + f, k] = rise * slope
        run_network(perceptron, encoded, activations, answer)
        values[tile : tile + size] = answer[:size]
        run_backwards(perceptron, back, activations, scratch, by_feature)
        for k in range(TILE):
            answer[k] = 0
        for i in range(inputs):
            for k in range(TILE):
                answer[k] += by_feature[i, k] * tangents[i, k]
        for k in range(size):
            # Half, since a canonical axis is two units long; and none where the point was clamped.
            inside = np.float32(0.5) if abs(axial[tile + k]) <= np.float32(1.0) else np.float32(0.0)
            slopes[tile + k] = inside * answer[k]


@njit(**KERNEL)
def _blend_across(
    lateral: np.float32,
    bscan: np.float32,
    first: int,
    last: int,
    level: int,
    encoding: Encoding,
    passed: NDArray[np.float32],
) -> None:
    """Write the features [last - first, features] of a level's axial vertices `first` to `last` on one line."""
    factors, first_row, mask = encoding.factors[level], encoding.first_row[level], encoding.mask[level]
    cell_z, share_z, _ = cell_of(bscan, encoding.scale[level, 0], encoding.smooth)
    cell_x, share_x, _ = cell_of(lateral, encoding.scale[level, 2], encoding.smooth)
    z0, x0 = cell_z * factors[0], cell_x * factors[2]
    z1, x1 = z0 + factors[0], x0 + factors[2]
    for number in range(first, last):
        y = number * factors[1]
        r00, r01 = table_row(z0, y, x0, first_row, mask), table_row(z0, y, x1, first_row, mask)
        r10, r11 = table_row(z1, y, x0, first_row, mask), table_row(z1, y, x1, first_row, mask)
        for f in range(encoding.table.shape[1]):
            near = encoding.table[r00, f]
            near += (encoding.table[r01, f] - near) * share_x
            far = encoding.table[r10, f]
            far += (encoding.table[r11, f] - far) * share_x
            passed[number - first, f] = near + (far - near) * share_z
