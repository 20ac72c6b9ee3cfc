"""Layers of the perceptron on tiles of TILE points, features first, so that every inner loop runs along the points.

Widths are padded to multiples of PAD with zeros; the loops below take that many rows at a time, which keeps more
arithmetic per load than one row would.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Perceptron, WayBack
from octn_ros.field.compiled.options import KERNEL, TILE

PAD = 4


@njit(**KERNEL)
def multiply(matrix: NDArray[np.float32], source: NDArray[np.float32], target: NDArray[np.float32]) -> None:
    """Write matrix [out, in] times source [in, TILE] into target [out, TILE]; out and in are multiples of PAD."""
    outputs, inputs = matrix.shape
    for j in range(0, outputs, 2):
        for k in range(TILE):
            target[j, k] = 0
            target[j + 1, k] = 0
        for i in range(0, inputs, PAD):
            a0, a1, a2, a3 = matrix[j, i], matrix[j, i + 1], matrix[j, i + 2], matrix[j, i + 3]
            b0, b1, b2, b3 = matrix[j + 1, i], matrix[j + 1, i + 1], matrix[j + 1, i + 2], matrix[j + 1, i + 3]
            for k in range(TILE):
                s0, s1, s2, s3 = source[i, k], source[i + 1, k], source[i + 2, k], source[i + 3, k]
                target[j, k] += a0 * s0 + a1 * s1 + a2 * s2 + a3 * s3
                target[j + 1, k] += b0 * s0 + b1 * s1 + b2 * s2 + b3 * s3


@njit(**KERNEL)
def activate(bias: NDArray[np.float32], values: NDArray[np.float32]) -> None:
    """Add a bias [out] to values [out, TILE] and cut them off at zero, in place (ReLU)."""
    for j in range(values.shape[0]):
        for k in range(TILE):
            values[j, k] = max(values[j, k] + bias[j], np.float32(0.0))


@njit(**KERNEL)
def gate(activation: NDArray[np.float32], gradient: NDArray[np.float32]) -> None:
    """Clear a gradient [out, TILE] where the activation is cut off, in place: the derivative of ReLU."""
    for j in range(gradient.shape[0]):
        for k in range(TILE):
            if activation[j, k] <= np.float32(0.0):
                gradient[j, k] = np.float32(0.0)


@njit(**KERNEL)
def run_network(
    perceptron: Perceptron,
    features: NDArray[np.float32],
    activations: NDArray[np.float32],
    values: NDArray[np.float32],
) -> None:
    """Run the network: activations [layers, neurons, TILE] and values [TILE] from features [inputs, TILE]."""
    multiply(perceptron.first, features, activations[0])
    activate(perceptron.first_bias, activations[0])
    last = perceptron.more.shape[0]
    for layer in range(last):
        multiply(perceptron.more[layer], activations[layer], activations[layer + 1])
        activate(perceptron.more_bias[layer], activations[layer + 1])
    for k in range(TILE):
        values[k] = perceptron.output_bias
    for j in range(len(perceptron.output)):
        for k in range(TILE):
            values[k] += perceptron.output[j] * activations[last, j, k]


@njit(**KERNEL)
def run_backwards(
    perceptron: Perceptron,
    back: WayBack,
    activations: NDArray[np.float32],
    scratch: NDArray[np.float32],
    gradient: NDArray[np.float32],
) -> None:
    """Write the derivative of the value by each feature into gradient [inputs, TILE].

    Args:
        perceptron: the network.
        back: its way back.
        activations: as `run_network` left them.
        scratch: [2, neurons, TILE], overwritten.
        gradient: written.
    """
    last = perceptron.more.shape[0]
    for j in range(len(perceptron.output)):
        for k in range(TILE):
            scratch[0, j, k] = perceptron.output[j]
    gate(activations[last], scratch[0])
    now = 0
    for layer in range(last - 1, -1, -1):
        multiply(back.more[layer], scratch[now], scratch[1 - now])
        gate(activations[layer], scratch[1 - now])
        now = 1 - now
    multiply(back.first, scratch[now], gradient)


@njit(**KERNEL)
def add_outer(
    gradient: NDArray[np.float32],
    source: NDArray[np.float32],
    weight_gradient: NDArray[np.float32],
    bias_gradient: NDArray[np.float32],
) -> None:
    """Add the gradients of a layer's weight [out, in] and bias [out], summed over the tile."""
    outputs, inputs = weight_gradient.shape
    for j in range(outputs):
        total = np.float32(0.0)
        for k in range(TILE):
            total += gradient[j, k]
        bias_gradient[j] += total
        for i in range(0, inputs, PAD):
            t0, t1, t2, t3 = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(TILE):
                g = gradient[j, k]
                t0 += g * source[i, k]
                t1 += g * source[i + 1, k]
                t2 += g * source[i + 2, k]
                t3 += g * source[i + 3, k]
            weight_gradient[j, i] += t0
            weight_gradient[j, i + 1] += t1
            weight_gradient[j, i + 2] += t2
            weight_gradient[j, i + 3] += t3
