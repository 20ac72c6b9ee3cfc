"""What the kernels take of a neural model, and the threads that run them."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.field.compiled.arrays import Encoding, Perceptron, WayBack
from octn_ros.field.compiled.layers import PAD

if TYPE_CHECKING:
    from octn_ros.field.neural import NeuralModel


def encoding_of(model: NeuralModel) -> Encoding:
    """View a model's hash grid; its table is shared, not copied."""
    levels = model.grid.grid_levels
    return Encoding(
        table=model.grid.table.detach().numpy(),
        scale=np.array([level.scale[::-1] for level in levels], np.float32),
        factors=np.array([level.factors[::-1] for level in levels], np.int64),
        first_row=np.array([level.first_row for level in levels], np.int64),
        mask=np.array([-1 if level.dense else level.size - 1 for level in levels], np.int64),
        smooth=model.grid.config.interpolation == "smoothstep",
    )


def perceptron_of(model: NeuralModel) -> Perceptron:
    """Copy a model's network into padded arrays."""
    *hidden, output = model.network.linear_layers
    weights = [_padded(layer.weight) for layer in hidden]
    biases = [_padded(layer.bias) for layer in hidden]
    neurons = len(biases[0])
    return Perceptron(
        first=weights[0],
        first_bias=biases[0],
        more=np.stack(weights[1:]) if len(hidden) > 1 else np.zeros((0, neurons, neurons), np.float32),
        more_bias=np.stack(biases[1:]) if len(hidden) > 1 else np.zeros((0, neurons), np.float32),
        output=_padded(output.weight[0]),
        output_bias=np.float32(output.bias[0].item()),
    )


def way_back_of(perceptron: Perceptron) -> WayBack:
    """Copy what the kernels need to go back through a network."""
    return WayBack(
        np.ascontiguousarray(perceptron.first.T), np.ascontiguousarray(perceptron.more.transpose(0, 2, 1))
    )  # fmt: skip


@lru_cache(maxsize=1)
def workers() -> ThreadPoolExecutor:
    """Return the threads that run kernels, as many as torch would use."""
    return ThreadPoolExecutor(min(torch.get_num_threads(), os.cpu_count() or 1), "octn-kernel")


def in_parts(part: Callable[[int, int], None], count: int, size: int) -> None:
    """Do a job from `start` to `stop` for every `size` of `count` things, on the threads that run kernels."""
    list(workers().map(lambda start: part(start, min(start + size, count)), range(0, count, size)))


def _padded(parameter: torch.Tensor) -> NDArray[np.float32]:
    values = parameter.detach().numpy()
    return np.ascontiguousarray(np.pad(values, [(0, -size % PAD) for size in values.shape]), dtype=np.float32)
