"""A neural model's answers from Triton kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import triton
from torch import Tensor, nn

from octn_ros.field.cuda.differentiated import DifferentiatedEvaluator
from octn_ros.field.cuda.encoding import TritonEncoding
from octn_ros.field.cuda.fused_kernel import STRIP_FEATURES as STRIP
from octn_ros.field.cuda.fused_kernel import fused_kernel
from octn_ros.field.cuda.levels import Levels

if TYPE_CHECKING:
    from octn_ros.field.network import Network
    from octn_ros.field.neural import NeuralModel

# Neurons that fit on the chip beside the points: wider networks run layer by layer.
MOST_NEURONS = 128
LAUNCH: dict[str, Any] = {"num_warps": 4, "num_stages": 1, "enable_fp_fusion": True}


class FusedNetwork(NamedTuple):
    """A network's parameters as the fused kernel takes them: transposed, and padded with zeros to neurons.

    Attributes:
        first: weight of the first hidden layer [inputs, rounded up to strips; neurons].
        first_bias: its bias [neurons].
        more: weights of the other hidden layers [layers - 1, neurons, neurons].
        more_bias: their biases [layers - 1, neurons].
        output: weight of the output [neurons].
        output_bias: its bias [1].
    """

    first: Tensor
    first_bias: Tensor
    more: Tensor
    more_bias: Tensor
    output: Tensor
    output_bias: Tensor

    @classmethod
    def of(cls, network: Network) -> FusedNetwork:
        """Copy a network."""
        *hidden, output = network.linear_layers
        first, *more = hidden
        neurons = max(16, triton.next_power_of_2(first.out_features))
        more_weights = first.weight.new_zeros(len(more), neurons, neurons)
        more_biases = first.weight.new_zeros(len(more), neurons)
        for layer, weight, bias in zip(more, more_weights, more_biases, strict=True):
            _copy_into(weight, layer.weight.t())
            _copy_into(bias, layer.bias)
        strips = triton.cdiv(first.in_features, STRIP)
        return cls(
            _copy_into(first.weight.new_zeros(strips * STRIP, neurons), first.weight.t()),
            _copy_into(first.bias.new_zeros(neurons), first.bias),
            more_weights,
            more_biases,
            _copy_into(first.weight.new_zeros(neurons), output.weight[0]),
            output.bias.detach().clone(),
        )


class TritonModel:
    """A model whose encoding is run by Triton kernels and whose network by torch: what a fit differentiates.

    Differentiable once, in the parameters and in the points; otherwise as the model itself, whose parameters it
    shares.

    Args:
        model: the model.
    """

    def __init__(self, model: NeuralModel) -> None:
        self._encoding, self._network = TritonEncoding(model.grid), model.network

    def __call__(self, points: Tensor) -> Tensor:
        """Map canonical points [N, 3] to intensities [N]."""
        values: Tensor = self._network(self._encoding(points))
        return values


class TritonEvaluator(DifferentiatedEvaluator):
    """Evaluates a model whose parameters stay as they are; equal to the model itself up to rounding.

    Values come from one fused kernel where the network has at most 128 neurons a layer; gradients from the encoding's
    kernels and torch's matrix products. Where tensor cores take part, products of float32 are taken on them in three
    parts, with an error near that of float32. CUDA, or the CPU under Triton's interpreter; thread-safe; keeps no graph.

    Args:
        model: the fitted model; its table is shared, its network copied for the fused kernel.

    Attributes:
        constants: what the fused kernel is compiled for.
    """

    def __init__(self, model: NeuralModel) -> None:
        super().__init__(TritonModel(model))
        self._grid, self._levels = model.grid, Levels.of(model.grid)
        self._more_layers = len(model.network.linear_layers) - 2
        self._fused = FusedNetwork.of(model.network) if model.network.output.in_features <= MOST_NEURONS else None
        activation = model.network.hidden[1]
        neurons = self._fused.output.shape[0] if self._fused else 0
        self.constants: dict[str, Any] = {
            "width": model.grid.config.features,
            "smooth": model.grid.config.interpolation == "smoothstep",
            "sharpness": activation.beta if isinstance(activation, nn.Softplus) else 0.0,
            "neurons": neurons,
            "precision": _precision(model.grid.table.device),
            # As many points as leave registers for what is kept of each, by the compiler's own account.
            "block": 32 if neurons > 64 else 64,
        }

    def evaluate(self, points: Tensor) -> Tensor:
        """Return intensities [N] at canonical points [N, 3]."""
        if self._fused is None or len(points) == 0:
            return super().evaluate(points)
        flat = points.detach().float().contiguous().view(-1)
        return self._run(self._fused, (flat, flat[1:], flat[2:]), flat.new_empty(len(points)), lattice=False)

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors."""
        if self._fused is None or 0 in (len(lateral), len(axial), len(bscan)):
            return super().lattice(lateral, axial, bscan)
        axes = tuple(axis.detach().float().contiguous() for axis in (lateral, axial, bscan))
        answer = axes[0].new_empty(len(bscan), len(axial), len(lateral))
        return self._run(self._fused, axes, answer, lattice=True)

    def _run(self, network: FusedNetwork, axes: tuple[Tensor, ...], answer: Tensor, *, lattice: bool) -> Tensor:
        _, axials, laterals = answer.shape if lattice else (1, 1, 1)
        programs = triton.cdiv(answer.numel(), self.constants["block"])
        with torch.cuda.device_of(answer):
            fused_kernel[(programs,)](
                *axes, self._grid.table, *self._levels, *network, answer,
                answer.numel(), axials, laterals, self._grid.width, self._more_layers,
                lattice=lattice, **self.constants, **LAUNCH,
            )  # fmt: skip
        return answer


def _precision(device: torch.device) -> str:
    """Return how Triton multiplies float32: on tensor cores where they take it (Ampere and later)."""
    tensor_cores = device.type == "cuda" and torch.cuda.get_device_capability(device)[0] >= 8
    return "tf32x3" if tensor_cores else "ieee"


def _copy_into(target: Tensor, values: Tensor) -> Tensor:
    """Copy values to the beginning of each axis of a larger tensor; return that tensor."""
    target[tuple(slice(size) for size in values.shape)] = values.detach()
    return target
