"""Triton kernels of the hash grid: features of points, and their gradients by the table and by the points.

The arithmetic is the reference's (`GridLevel`), point by point, in float32. NaN coordinates give NaN features.
Parameters are not annotated, since Triton reads annotations as its own.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def place(coordinate, scale, smooth: tl.constexpr):
    """Return the cell of canonical coordinates, the share of its far vertex, and that share's slope."""
    held = tl.where(coordinate > -1.0, tl.minimum(coordinate, 1.0), -1.0)
    position = (held + 1.0) * 0.5 * scale + 0.5
    cell = tl.floor(position)
    share = position - cell
    # Half: a canonical axis is two units long. Outside the cube the value is held.
    slope = tl.where(tl.abs(coordinate) <= 1.0, 0.5 * scale, 0.0)
    if smooth:
        slope = slope * 6.0 * share * (1.0 - share)
        share = share * share * (3.0 - 2.0 * share)
    return cell.to(tl.int32), tl.where(coordinate == coordinate, share, coordinate), slope


@triton.jit
def table_row(lateral, axial, bscan, first_row, mask):
    """Return table rows (int64) of vertices from their factored numbers along the three axes."""
    return first_row + tl.where(mask < 0, lateral + axial + bscan, (lateral ^ axial ^ bscan) & mask)


@triton.jit(do_not_specialize=["count"])
def encode_kernel(
    points,
    table,
    scale,
    factor,
    first_row,
    mask,
    features,
    count,
    width: tl.constexpr,
    tile_width: tl.constexpr,
    smooth: tl.constexpr,
    block: tl.constexpr,
):
    """Write the features [levels * width, count] of points [count, 3]: one program a level and block points.

    `width` features lie in each table row, `tile_width` is the power of two that holds them.
    """
    level = tl.program_id(1)
    number = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    there = number < count
    cell_x, share_x, _ = place(tl.load(points + 3 * number, there, 0.0), tl.load(scale + 3 * level), smooth)
    cell_y, share_y, _ = place(tl.load(points + 3 * number + 1, there, 0.0), tl.load(scale + 3 * level + 1), smooth)
    cell_z, share_z, _ = place(tl.load(points + 3 * number + 2, there, 0.0), tl.load(scale + 3 * level + 2), smooth)
    factor_x, factor_y = tl.load(factor + 3 * level), tl.load(factor + 3 * level + 1)
    factor_z, first, hashed = tl.load(factor + 3 * level + 2), tl.load(first_row + level), tl.load(mask + level)
    feature = tl.arange(0, tile_width)
    wanted = there[:, None] & (feature < width)[None, :]
    total = tl.zeros((block, tile_width), tl.float32)
    for dz in tl.static_range(2):
        weight_z = share_z if dz else 1.0 - share_z
        for dy in tl.static_range(2):
            weight_y = share_y if dy else 1.0 - share_y
            for dx in tl.static_range(2):
                weight_x = share_x if dx else 1.0 - share_x
                row = table_row(
                    (cell_x + dx) * factor_x, (cell_y + dy) * factor_y, (cell_z + dz) * factor_z, first, hashed
                )
                value = tl.load(table + row[:, None] * width + feature[None, :], wanted, 0.0)
                total += (weight_x * weight_y * weight_z)[:, None] * value
    tl.store(features + (level * width + feature)[None, :].to(tl.int64) * count + number[:, None], total, wanted)


@triton.jit(do_not_specialize=["count", "point_stride", "feature_stride"])
def table_gradient_kernel(
    points,
    by_features,
    scale,
    factor,
    first_row,
    mask,
    by_table,
    count,
    point_stride,
    feature_stride,
    width: tl.constexpr,
    tile_width: tl.constexpr,
    smooth: tl.constexpr,
    block: tl.constexpr,
):
    """Add to the gradient by the table [rows, width] that by the features of points [count, 3].

    Many points share a row, so the additions are atomic; their order, and with it the rounding, is left to chance.
    """
    level = tl.program_id(1)
    number = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    there = number < count
    cell_x, share_x, _ = place(tl.load(points + 3 * number, there, 0.0), tl.load(scale + 3 * level), smooth)
    cell_y, share_y, _ = place(tl.load(points + 3 * number + 1, there, 0.0), tl.load(scale + 3 * level + 1), smooth)
    cell_z, share_z, _ = place(tl.load(points + 3 * number + 2, there, 0.0), tl.load(scale + 3 * level + 2), smooth)
    factor_x, factor_y = tl.load(factor + 3 * level), tl.load(factor + 3 * level + 1)
    factor_z, first, hashed = tl.load(factor + 3 * level + 2), tl.load(first_row + level), tl.load(mask + level)
    feature = tl.arange(0, tile_width)
    wanted = there[:, None] & (feature < width)[None, :]
    column = (level * width + feature)[None, :].to(tl.int64) * feature_stride
    gradient = tl.load(by_features + number[:, None] * point_stride + column, wanted, 0.0)
    for dz in tl.static_range(2):
        weight_z = share_z if dz else 1.0 - share_z
        for dy in tl.static_range(2):
            weight_y = share_y if dy else 1.0 - share_y
            for dx in tl.static_range(2):
                weight_x = share_x if dx else 1.0 - share_x
                row = table_row(
                    (cell_x + dx) * factor_x, (cell_y + dy) * factor_y, (cell_z + dz) * factor_z, first, hashed
                )
                weight = (weight_x * weight_y * weight_z)[:, None]
                target = by_table + row[:, None] * width + feature[None, :]
                tl.atomic_add(target, weight * gradient, wanted, sem="relaxed")


@triton.jit(do_not_specialize=["count", "point_stride", "feature_stride", "levels"])
def point_gradient_kernel(
    points,
    table,
    by_features,
    scale,
    factor,
    first_row,
    mask,
    by_points,
    count,
    point_stride,
    feature_stride,
    levels,
    width: tl.constexpr,
    tile_width: tl.constexpr,
    smooth: tl.constexpr,
    block: tl.constexpr,
):
    """Write the gradient by points [count, 3] from that by their features: one program block points, all levels."""
    number = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    there = number < count
    x, y = tl.load(points + 3 * number, there, 0.0), tl.load(points + 3 * number + 1, there, 0.0)
    z = tl.load(points + 3 * number + 2, there, 0.0)
    feature = tl.arange(0, tile_width)
    wanted = there[:, None] & (feature < width)[None, :]
    by_x = tl.zeros((block,), tl.float32)
    by_y = tl.zeros((block,), tl.float32)
    by_z = tl.zeros((block,), tl.float32)
    for level in range(levels):
        cell_x, share_x, slope_x = place(x, tl.load(scale + 3 * level), smooth)
        cell_y, share_y, slope_y = place(y, tl.load(scale + 3 * level + 1), smooth)
        cell_z, share_z, slope_z = place(z, tl.load(scale + 3 * level + 2), smooth)
        factor_x, factor_y = tl.load(factor + 3 * level), tl.load(factor + 3 * level + 1)
        factor_z, first, hashed = tl.load(factor + 3 * level + 2), tl.load(first_row + level), tl.load(mask + level)
        column = (level * width + feature)[None, :].to(tl.int64) * feature_stride
        gradient = tl.load(by_features + number[:, None] * point_stride + column, wanted, 0.0)
        for dz in tl.static_range(2):
            weight_z = share_z if dz else 1.0 - share_z
            change_z = slope_z if dz else -slope_z
            for dy in tl.static_range(2):
                weight_y = share_y if dy else 1.0 - share_y
                change_y = slope_y if dy else -slope_y
                for dx in tl.static_range(2):
                    weight_x = share_x if dx else 1.0 - share_x
                    change_x = slope_x if dx else -slope_x
                    row = table_row(
                        (cell_x + dx) * factor_x, (cell_y + dy) * factor_y, (cell_z + dz) * factor_z, first, hashed
                    )
                    value = tl.load(table + row[:, None] * width + feature[None, :], wanted, 0.0)
                    along = tl.sum(value * gradient, axis=1)
                    by_x += change_x * weight_y * weight_z * along
                    by_y += weight_x * change_y * weight_z * along
                    by_z += weight_x * weight_y * change_z * along
    tl.store(by_points + 3 * number, by_x, there)
    tl.store(by_points + 3 * number + 1, by_y, there)
    tl.store(by_points + 3 * number + 2, by_z, there)
