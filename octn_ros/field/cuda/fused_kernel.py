"""The Triton kernel that answers for whole fields: encoding and network in one pass, features never leave the chip.

Its parameters are not annotated, since Triton reads annotations as its own.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import triton
import triton.language as tl

from octn_ros.field.cuda.encode_kernels import place, table_row

# Features that one step of the first layer takes: the least that tensor cores multiply at once.
STRIP_FEATURES = 16
STRIP = tl.constexpr(STRIP_FEATURES)


@triton.jit
def activate(value, sharpness: tl.constexpr):
    """Apply ReLU, or softplus of a sharpness above 0 as torch does; NaN stays NaN."""
    if sharpness > 0:
        sharp = value * sharpness
        bent = tl.log(1.0 + tl.exp(tl.minimum(sharp, 20.0))) / sharpness
        value = tl.where(sharp < 20.0, bent, value)
    else:
        value = tl.where(value < 0.0, 0.0, value)
    return value


@triton.jit
def halves(value, block: tl.constexpr, width: tl.constexpr):
    """Split a tile [block, width] into its left and its right half."""
    return tl.split(tl.permute(tl.reshape(value, (block, 2, width // 2)), (0, 2, 1)))


@triton.jit
def multiply_strip(hidden, weight, start, total, strip: tl.constexpr, neurons: tl.constexpr, precision: tl.constexpr):
    """Return total plus hidden [block, strip] times the rows of a weight [neurons, neurons] that begin at `start`."""
    place_of_weight = (start + tl.arange(0, strip))[:, None] * neurons + tl.arange(0, neurons)[None, :]
    return tl.dot(hidden, tl.load(weight + place_of_weight), total, input_precision=precision)


@triton.jit(do_not_specialize=["count", "axials", "laterals", "inputs", "more_layers"])
def fused_kernel(
    lateral,
    axial,
    bscan,
    table,
    scale,
    factor,
    first_row,
    mask,
    first,
    first_bias,
    more,
    more_bias,
    output,
    output_bias,
    values,
    count,
    axials,
    laterals,
    inputs,
    more_layers,
    lattice: tl.constexpr,
    width: tl.constexpr,
    smooth: tl.constexpr,
    sharpness: tl.constexpr,
    neurons: tl.constexpr,
    precision: tl.constexpr,
    block: tl.constexpr,
):
    """Write the intensities [count] at points, or at the places of a lattice [bscan, axial, lateral].

    Points lie at (lateral[i], axial[i], bscan[i]) with a stride of 3 each; of a lattice these are its axes. Weights
    are transposed, [in, neurons], and padded with zeros.
    """
    number = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    there = number < count
    if lattice:
        line = number // laterals
        x = tl.load(lateral + number % laterals, there, 0.0)
        y = tl.load(axial + line % axials, there, 0.0)
        z = tl.load(bscan + line // axials, there, 0.0)
    else:
        x = tl.load(lateral + 3 * number, there, 0.0)
        y = tl.load(axial + 3 * number, there, 0.0)
        z = tl.load(bscan + 3 * number, there, 0.0)
    neuron = tl.arange(0, neurons)
    strip = tl.arange(0, STRIP)
    total = tl.zeros((block, neurons), tl.float32)
    for start in range(0, inputs, STRIP):
        column = start + strip
        wanted = there[:, None] & (column < inputs)[None, :]
        level = tl.where(column < inputs, column // width, 0)
        feature = column % width
        cell_x, share_x, _ = place(x[:, None], tl.load(scale + 3 * level)[None, :], smooth)
        cell_y, share_y, _ = place(y[:, None], tl.load(scale + 3 * level + 1)[None, :], smooth)
        cell_z, share_z, _ = place(z[:, None], tl.load(scale + 3 * level + 2)[None, :], smooth)
        factor_x = tl.load(factor + 3 * level)[None, :]
        factor_y = tl.load(factor + 3 * level + 1)[None, :]
        factor_z = tl.load(factor + 3 * level + 2)[None, :]
        row_0, hashed = tl.load(first_row + level)[None, :], tl.load(mask + level)[None, :]
        encoded = tl.zeros((block, STRIP), tl.float32)
        for dz in tl.static_range(2):
            weight_z = share_z if dz else 1.0 - share_z
            for dy in tl.static_range(2):
                weight_y = share_y if dy else 1.0 - share_y
                for dx in tl.static_range(2):
                    weight_x = share_x if dx else 1.0 - share_x
                    row = table_row(
                        (cell_x + dx) * factor_x, (cell_y + dy) * factor_y, (cell_z + dz) * factor_z, row_0, hashed
                    )
                    value = tl.load(table + row * width + feature[None, :], wanted, 0.0)
                    encoded += weight_x * weight_y * weight_z * value
        weight = tl.load(first + column[:, None] * neurons + neuron[None, :])
        total = tl.dot(encoded, weight, total, input_precision=precision)
    hidden = activate(total + tl.load(first_bias + neuron)[None, :], sharpness)
    for layer in range(more_layers):
        weight = more + layer * neurons * neurons
        total = tl.zeros((block, neurons), tl.float32)
        if neurons > 64:
            # A quarter of the weight at a time: shared memory has no room for all of it.
            left, right = halves(hidden, block, neurons)
            part_0, part_1 = halves(left, block, neurons // 2)
            part_2, part_3 = halves(right, block, neurons // 2)
            total = multiply_strip(part_0, weight, 0, total, neurons // 4, neurons, precision)
            total = multiply_strip(part_1, weight, neurons // 4, total, neurons // 4, neurons, precision)
            total = multiply_strip(part_2, weight, neurons // 2, total, neurons // 4, neurons, precision)
            total = multiply_strip(part_3, weight, 3 * neurons // 4, total, neurons // 4, neurons, precision)
        else:
            total = multiply_strip(hidden, weight, 0, total, neurons, neurons, precision)
        hidden = activate(total + tl.load(more_bias + layer * neurons + neuron)[None, :], sharpness)
    value = tl.sum(hidden * tl.load(output + neuron)[None, :], axis=1) + tl.load(output_bias)
    tl.store(values + number, value, there)
