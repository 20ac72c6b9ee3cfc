"""A neural model's answers from compiled kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from octn_ros.field.compiled.lattice import evaluate_lattice
from octn_ros.field.compiled.lines import evaluate_axial_slopes, evaluate_lines
from octn_ros.field.compiled.model import encoding_of, perceptron_of
from octn_ros.field.compiled.points import evaluate_points

if TYPE_CHECKING:
    from octn_ros.field.neural import NeuralModel


class CompiledEvaluator:
    """Evaluates a model whose parameters stay as they are; equal to the model itself up to rounding.

    CPU and float32 only; thread-safe; keeps no graph.

    Args:
        model: the fitted model; its table is shared, its network copied.
    """

    def __init__(self, model: NeuralModel) -> None:
        self._encoding, self._perceptron = encoding_of(model), perceptron_of(model)

    def evaluate(self, points: Tensor) -> Tensor:
        """Return intensities [N] at canonical points [N, 3]."""
        return self._ask(points, gradients=False)[0]

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] at canonical points [N, 3]."""
        return self._ask(points, gradients=True)

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors."""
        axes = (axis.detach().contiguous().numpy() for axis in (lateral, axial, bscan))
        return torch.from_numpy(evaluate_lattice(self._encoding, self._perceptron, *axes))

    def axial_lines(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        """Return intensities [N, K] at canonical depths [N, K] along the axial lines at lateral [N], bscan [N]."""
        axes = (axis.detach().contiguous().numpy() for axis in (lateral, bscan, axial))
        return torch.from_numpy(evaluate_lines(self._encoding, self._perceptron, *axes))

    def axial_value_and_slope(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N]."""
        axes = (axis.detach().contiguous().numpy() for axis in (lateral, axial, bscan))
        values, slopes = evaluate_axial_slopes(self._encoding, self._perceptron, *axes)
        return torch.from_numpy(values), torch.from_numpy(slopes)

    def _ask(self, points: Tensor, *, gradients: bool) -> tuple[Tensor, Tensor]:
        array = points.detach().contiguous().numpy()
        values, gradient = evaluate_points(self._encoding, self._perceptron, array, gradients=gradients)
        return torch.from_numpy(values), torch.from_numpy(gradient)
