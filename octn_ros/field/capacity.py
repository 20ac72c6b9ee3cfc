"""Capacity that follows the volume: a grid whose parameters are in proportion to the voxels they stand for."""

from __future__ import annotations

import dataclasses
import math

from octn_ros.errors import ConfigurationError
from octn_ros.field.grid_level import vertices_along
from octn_ros.field.hash_grid import HashGridConfig

PARAMETER_BITS = 32  # as trained, and as stored in files; messages carry half
# 1 GiB of float32; the gradient and Adam's two moments take as much each.
MOST_PARAMETERS = 1 << 28
# All levels together over the finest one, where resolution doubles from level to level: 1 + 1/8 + 1/64 + ...
_PYRAMID = 8.0 / 7.0
_BISECTIONS = 48
_COARSEST_RATIO, _FINEST_RATIO = 0.05, 4.0


def bits_per_voxel(grid: HashGridConfig, shape: tuple[int, int, int]) -> float:
    """Return the bits of a grid's tables, as float32, over the voxels (bscan, axial, lateral) of a volume."""
    return _rows(grid, shape) * grid.features * PARAMETER_BITS / math.prod(shape)


def grid_for_volume(grid: HashGridConfig, shape: tuple[int, int, int], bits: float) -> HashGridConfig:
    """Return the grid with `bits` of table per voxel of a volume, all levels dense, cells shaped as the voxels.

    Resolution doubles from level to level, as far as the budget goes: the finest level has the cells per voxel that
    make the sum right. The table holds its every vertex, for speckle leaves no empty cells that could share rows. Very
    large volumes get fewer bits, so that the table stays within 1 GiB; very small ones may miss by the few vertices
    that an axis cannot do without.

    Args:
        grid: what stays as configured: features, interpolation, and the coarsest level where the volume allows it.
        shape: voxels along (bscan, axial, lateral).
        bits: bits of parameters, as float32, per voxel; above 0.

    Raises:
        ConfigurationError: no bits are asked for.
    """
    if not bits > 0:
        raise ConfigurationError(f"bits_per_voxel: expected more than 0 to resolve a grid, got {bits}")
    voxels, longest = math.prod(shape), max(shape)
    wanted = min(bits * voxels / PARAMETER_BITS, MOST_PARAMETERS)
    # Levels from the cells per voxel that a finest level alone would need.
    about = _clamped((wanted / grid.features / voxels / _PYRAMID) ** (1.0 / 3.0))
    base = max(2, min(grid.base_resolution, round(about * longest / 2)))
    levels = 1 + max(1, round(math.log2(max(about * longest / base, 1.0))))
    low, high = _COARSEST_RATIO, _FINEST_RATIO
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        fits = _rows(_shaped(grid, levels, base, middle), shape) * grid.features <= wanted
        low, high = (middle, high) if fits else (low, middle)
    return _with_dense_table(_shaped(grid, levels, base, low), shape)


def _shaped(grid: HashGridConfig, levels: int, base: int, ratio: float) -> HashGridConfig:
    return dataclasses.replace(
        grid,
        levels=levels,
        base_resolution=base,
        finest_ratio=ratio,
        follow_shape=True,
        log2_table_size=28,
        lateral_growth=0.0,
    )


def _with_dense_table(grid: HashGridConfig, shape: tuple[int, int, int]) -> HashGridConfig:
    finest = max(math.prod(vertices_along(scale)) for scale in grid.level_scales(shape))
    return dataclasses.replace(grid, log2_table_size=max(4, math.ceil(math.log2(finest))))


def _rows(grid: HashGridConfig, shape: tuple[int, int, int]) -> int:
    capacity = 2**grid.log2_table_size
    return sum(min(math.prod(vertices_along(scale)), capacity) for scale in grid.level_scales(shape))


def _clamped(ratio: float) -> float:
    return min(max(ratio, _COARSEST_RATIO), _FINEST_RATIO)
