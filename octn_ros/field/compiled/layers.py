"""Layers of the perceptron on tiles of points, features first, so that every inner loop runs along the points.

A tile holds as many points as its arrays are wide. Widths of the layers are padded to multiples of PAD with zeros; the
loops below take that many rows at a time, which keeps more arithmetic per load than one row would. Rows are taken out
of their arrays before a loop, since the compiler cannot tell by itself that their places do not change.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Perceptron, WayBack
from octn_ros.field.compiled.options import KERNEL

PAD = 4


@njit(**KERNEL)
def multiply(matrix: NDArray[np.float32], source: NDArray[np.float32], target: NDArray[np.float32]) -> None:
    """Write matrix [out, in] times source [in, points] into target [out, points]; out and in are multiples of PAD."""
    outputs, inputs = matrix.shape
    for j in range(0, outputs, 2):
        t, u = target[j], target[j + 1]
        for i in range(0, inputs, PAD):
            a0, a1, a2, a3 = matrix[j, i], matrix[j, i + 1], matrix[j, i + 2], matrix[j, i + 3]
            b0, b1, b2, b3 = matrix[j + 1, i], matrix[j + 1, i + 1], matrix[j + 1, i + 2], matrix[j + 1, i + 3]
            s0, s1, s2, s3 = source[i], source[i + 1], source[i + 2], source[i + 3]
            if i == 0:
                for k in range(source.shape[1]):
                    t[k] = a0 * s0[k] + a1 * s1[k] + a2 * s2[k] + a3 * s3[k]
                    u[k] = b0 * s0[k] + b1 * s1[k] + b2 * s2[k] + b3 * s3[k]
            else:
                for k in range(source.shape[1]):
                    t[k] += a0 * s0[k] + a1 * s1[k] + a2 * s2[k] + a3 * s3[k]
                    u[k] += b0 * s0[k] + b1 * s1[k] + b2 * s2[k] + b3 * s3[k]


@njit(**KERNEL)
def activate(bias: NDArray[np.float32], values: NDArray[np.float32]) -> None:
    """Add a bias [out] to values [out, points] and cut them off at zero, in place (ReLU)."""
    for j in range(values.shape[0]):
        row = values[j]
        for k in range(row.shape[0]):
            row[k] = max(row[k] + bias[j], np.float32(0.0))


@njit(**KERNEL)
def gate(activation: NDArray[np.float32], gradient: NDArray[np.float32]) -> None:
    """Clear a gradient [out, points] where the activation is cut off, in place: the derivative of ReLU."""
    for j in range(gradient.shape[0]):
        a, g = activation[j], gradient[j]
        for k in range(g.shape[0]):
            g[k] = np.float32(0.0) if a[k] <= np.float32(0.0) else g[k]


@njit(**KERNEL)
def run_network(
    perceptron: Perceptron,
    features: NDArray[np.float32],
    activations: NDArray[np.float32],
    values: NDArray[np.float32],
) -> None:
    """Run the network: activations [layers, neurons, points] and values [points] from features [inputs, points]."""
    multiply(perceptron.first, features, activations[0])
    activate(perceptron.first_bias, activations[0])
    last = perceptron.more.shape[0]
    for layer in range(last):
        multiply(perceptron.more[layer], activations[layer], activations[layer + 1])
        activate(perceptron.more_bias[layer], activations[layer + 1])
    output = perceptron.output
    values[:] = perceptron.output_bias
    for j in range(0, len(output), PAD):
        a0, a1, a2, a3 = output[j], output[j + 1], output[j + 2], output[j + 3]
        s0, s1 = activations[last, j], activations[last, j + 1]
        s2, s3 = activations[last, j + 2], activations[last, j + 3]
        for k in range(len(values)):
            values[k] += a0 * s0[k] + a1 * s1[k] + a2 * s2[k] + a3 * s3[k]


@njit(**KERNEL)
def enter_backwards(
    output: NDArray[np.float32],
    error: NDArray[np.float32],
    activation: NDArray[np.float32],
    gradient: NDArray[np.float32],
    weight_gradient: NDArray[np.float32],
) -> None:
    """Pass the error [points] of the output back to the gradient [neurons, points] before the last activation.

    Args:
        output: weight of the output [neurons].
        error: derivative of the loss by the output.
        activation: of the last hidden layer [neurons, points].
        gradient: written.
        weight_gradient: of `output`, added to.
    """
    for j in range(len(output)):
        a, g, weight = activation[j], gradient[j], output[j]
        total = np.float32(0.0)
        for k in range(len(error)):
            total += error[k] * a[k]
            g[k] = np.float32(0.0) if a[k] <= np.float32(0.0) else error[k] * weight
        weight_gradient[j] += total


@njit(**KERNEL)
def run_backwards(
    perceptron: Perceptron,
    back: WayBack,
    activations: NDArray[np.float32],
    scratch: NDArray[np.float32],
    gradient: NDArray[np.float32],
) -> None:
    """Write the derivative of the value by each feature into gradient [inputs, points].

    Args:
        perceptron: the network.
        back: its way back.
        activations: as `run_network` left them.
        scratch: [2, neurons, points], overwritten.
        gradient: written.
    """
    last = perceptron.more.shape[0]
    for j in range(len(perceptron.output)):
        scratch[0, j] = perceptron.output[j]
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
    zero = np.float32(0.0)
    for j in range(0, outputs, 2):
        g, h = gradient[j], gradient[j + 1]
        of_g, of_h = zero, zero
        for k in range(len(g)):
            of_g += g[k]
            of_h += h[k]
        bias_gradient[j] += of_g
        bias_gradient[j + 1] += of_h
        for i in range(0, inputs, PAD):
            s0, s1, s2, s3 = source[i], source[i + 1], source[i + 2], source[i + 3]
            t0, t1, t2, t3, u0, u1, u2, u3 = zero, zero, zero, zero, zero, zero, zero, zero
            for k in range(len(g)):
                t0 += g[k] * s0[k]
                t1 += g[k] * s1[k]
                t2 += g[k] * s2[k]
                t3 += g[k] * s3[k]
                u0 += h[k] * s0[k]
                u1 += h[k] * s1[k]
                u2 += h[k] * s2[k]
                u3 += h[k] * s3[k]
            weight_gradient[j, i] += t0
            weight_gradient[j, i + 1] += t1
            weight_gradient[j, i + 2] += t2
            weight_gradient[j, i + 3] += t3
            weight_gradient[j + 1, i] += u0
            weight_gradient[j + 1, i + 1] += u1
            weight_gradient[j + 1, i + 2] += u2
            weight_gradient[j + 1, i + 3] += u3
