"""A neural model as the named tuples of arrays that the kernels take."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Encoding(NamedTuple):
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


class Perceptron(NamedTuple):
    """A network's parameters, padded with zeros to whole groups of rows and columns; or numbers of the same shapes,
    such as sums of their gradients with one more axis in front.

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
    output_bias: Any


class WayBack(NamedTuple):
    """The transposes of a perceptron's `first` and `more`, contiguous."""

    first: NDArray[np.float32]
    more: NDArray[np.float32]
