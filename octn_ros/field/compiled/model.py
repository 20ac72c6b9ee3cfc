"""A neural model as the arrays that the kernels take."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from octn_ros.field.compiled.layers import PAD

if TYPE_CHECKING:
    from octn_ros.field.neural import NeuralModel


@dataclass(frozen=True, eq=False)
class Encoding:
    """A hash grid; axes are ordered (bscan, axial, lateral), as lattices are.

    Attributes:
        table: feature rows [rows, features], shared with the model.
        scale: cells per unit length [levels, 3].
        factors: what vertex numbers are multiplied by [levels, 3].
        first_row: first table row of each level [levels].
        mask: hashed rows less one, -1 where a level is dense [levels].
        smooth: whether shares follow the smoothstep.
    """

    table: NDArray[np.float32]
    scale: NDArray[np.float32]
    factors: NDArray[np.int64]
    first_row: NDArray[np.int64]
    mask: NDArray[np.int64]
    smooth: bool

    @property
    def kernel_arguments(self) -> tuple[Any, ...]:
        """What the kernels take, in their order."""
        return self.table, self.scale, self.factors, self.first_row, self.mask, self.smooth


@dataclass(frozen=True, eq=False)
class Perceptron:
    """The network's parameters, padded to whole groups of PAD rows and columns with zeros; copies of the model's.

    Attributes:
        first: weight of the first hidden layer [neurons, inputs].
        first_bias: its bias [neurons].
        more: weights of the other hidden layers [layers - 1, neurons, neurons].
        more_bias: their biases [layers - 1, neurons].
        output: weight of the output [neurons].
        output_bias: its bias.
    """

    first: NDArray[np.float32]
    first_bias: NDArray[np.float32]
    more: NDArray[np.float32]
    more_bias: NDArray[np.float32]
    output: NDArray[np.float32]
    output_bias: np.float32

    @property
    def kernel_arguments(self) -> tuple[Any, ...]:
        """What the forward kernels take, in their order."""
        return self.first, self.first_bias, self.more, self.more_bias, self.output, self.output_bias

    @property
    def transposed(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The transposes of `first` and `more`, contiguous, for the way back."""
        return np.ascontiguousarray(self.first.T), np.ascontiguousarray(self.more.transpose(0, 2, 1))


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


def linear_layers(model: NeuralModel) -> list[nn.Linear]:
    """Return the model's linear layers from the first hidden one to the output."""
    return [layer for layer in [*model.network.hidden, model.network.output] if isinstance(layer, nn.Linear)]


def perceptron_of(model: NeuralModel) -> Perceptron:
    """Copy a model's network into padded arrays."""
    *hidden, output = linear_layers(model)
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


@lru_cache(maxsize=1)
def workers() -> ThreadPoolExecutor:
    """Return the threads that run kernels, as many as torch would use."""
    return ThreadPoolExecutor(min(torch.get_num_threads(), os.cpu_count() or 1), "octn-kernel")


def _padded(parameter: torch.Tensor) -> NDArray[np.float32]:
    values = parameter.detach().numpy()
    return np.ascontiguousarray(np.pad(values, [(0, -size % PAD) for size in values.shape]), dtype=np.float32)
