"""The encoding against a scalar reference, written point by point from tiny-cuda-nn's published formulas.

grid_scale, grid_resolution, pos_fract, grid_index and coherent_prime_hash of include/tiny-cuda-nn (grid.h and
common_device.h), for float32 inputs in [0, 1]^3 and 32-bit unsigned arithmetic.
"""

import itertools
import math

import pytest
import torch

from octn_ros.field.hash_grid import HashGrid, HashGridConfig

SHAPE = (64, 64, 64)
UINT32 = 2**32


def grid_scale(level, log2_growth, base):
    return 2.0 ** (level * log2_growth) * base - 1.0


def grid_resolution(scale):
    return math.ceil(scale) + 1


def prime_hash(vertex):
    result = 0
    for number, prime in zip(vertex, (1, 2654435761, 805459861), strict=True):
        result ^= number * prime % UINT32
    return result


def rows_of_level(resolution, log2_table):
    """params_in_level: dense if it fits, rounded up to 8 rows, at most the table."""
    return min((resolution**3 + 7) // 8 * 8, 2**log2_table)


def grid_index(vertex, resolution, rows):
    index, stride = 0, 1
    for number in vertex:
        index += number * stride
        stride *= resolution
    if rows < stride:
        index = prime_hash(vertex)
    return index % rows


def encode(point, table, scale, rows, smooth):
    """One level's features at one point: eight corners, each with the product of its three weights."""
    cell, weight = [], []
    for coordinate in point:
        position = coordinate * scale + 0.5
        floor = math.floor(position)
        fraction = position - floor
        cell.append(floor)
        weight.append(fraction * fraction * (3 - 2 * fraction) if smooth else fraction)
    total = [0.0] * len(table[0])
    for corner in itertools.product((0, 1), repeat=3):
        share = math.prod(w if far else 1 - w for w, far in zip(weight, corner, strict=True))
        vertex = [c + far for c, far in zip(cell, corner, strict=True)]
        row = table[grid_index(vertex, grid_resolution(scale), rows)]
        total = [t + share * value for t, value in zip(total, row, strict=True)]
    return total


def made(interpolation, log2_table=10):
    config = HashGridConfig(
        levels=6, features=2, log2_table_size=log2_table, base_resolution=4, interpolation=interpolation
    )
    torch.manual_seed(0)
    grid = HashGrid(config, SHAPE).double()
    with torch.no_grad():
        grid.table.uniform_(-1, 1)
    return grid


def published_table(grid, level, rows, resolution):
    """The rows of one of our levels in the order that the published index gives them."""
    ours = grid.table.detach()[level.first_row : level.first_row + level.size]
    if not level.dense:
        return ours.tolist()
    # A dense level of ours owns one vertex more along each axis, so its rows lie at other strides.
    table = [[math.nan] * grid.config.features] * rows
    for vertex in itertools.product(range(resolution), repeat=3):
        index = sum(number * stride for number, stride in zip(vertex, level.factors, strict=True))
        table[grid_index(vertex, resolution, rows)] = ours[index].tolist()
    return table


@pytest.mark.parametrize("interpolation", ["linear", "smoothstep"])
def test_features_equal_the_scalar_reference_on_dense_and_hashed_levels(interpolation):
    grid = made(interpolation)
    config = grid.config
    log2_growth = math.log2((64 / config.base_resolution) ** (1 / (config.levels - 1)))
    unit = torch.rand(60, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    # Beyond its last half cell a dense level of tiny-cuda-nn wraps around to the next row; ours does not.
    unit *= 1 - 0.75 / grid_scale(0, log2_growth, config.base_resolution)
    got = grid(unit * 2 - 1).detach().view(len(unit), config.levels, config.features)
    kinds = set()
    for number, level in enumerate(grid.grid_levels):
        scale = grid_scale(number, log2_growth, config.base_resolution)
        rows = rows_of_level(grid_resolution(scale), config.log2_table_size)
        kinds.add(level.dense)
        assert level.scale == pytest.approx((scale,) * 3)
        table = published_table(grid, level, rows, grid_resolution(scale))
        expected = [encode(point, table, scale, rows, interpolation == "smoothstep") for point in unit.tolist()]
        torch.testing.assert_close(got[:, number], torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-9)
    assert kinds == {True, False}


def test_hashed_levels_agree_up_to_the_faces_of_the_cube():
    grid = made("linear", log2_table=5)
    level = grid.grid_levels[-1]
    assert not level.dense
    unit = torch.rand(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    unit[:20] = unit[:20].round()
    table = published_table(grid, level, level.size, 0)
    expected = [encode(point, table, level.scale[0], level.size, False) for point in unit.tolist()]
    got = grid(unit * 2 - 1).detach()[:, -2:]
    torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-9)


def test_a_dense_level_does_not_wrap_around_at_the_far_face():
    """The one difference: at the far face tiny-cuda-nn reads the first vertices of the next row, we read our own."""
    grid = made("linear")
    level = grid.grid_levels[0]
    corner = torch.ones(1, 3, dtype=torch.float64)
    rows, _ = level.corners(corner)
    resolution = grid_resolution(level.scale[0])
    assert int(rows.max()) == level.first_row + level.size - 1
    assert level.vertices == (resolution + 1,) * 3
    assert grid_index((resolution, 0, 0), resolution, resolution**3) == grid_index((0, 1, 0), resolution, resolution**3)


def test_the_hash_of_vertices_worked_by_hand():
    assert prime_hash((1, 0, 0)) == 1
    assert prime_hash((0, 1, 0)) == 2654435761
    assert prime_hash((0, 2, 0)) == 2 * 2654435761 - UINT32
    assert prime_hash((3, 1, 1)) == 3 ^ 2654435761 ^ 805459861
