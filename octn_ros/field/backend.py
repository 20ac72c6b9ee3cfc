"""Which code answers for a neural field: plain torch, the reference, or something faster that equals it."""

from __future__ import annotations

import functools
import importlib.util
import os
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, Protocol

import torch
from torch import Tensor, nn

from octn_ros.errors import BackendWarning, ConfigurationError

if TYPE_CHECKING:
    from octn_ros.field.neural import NeuralModel

Backend = Literal["torch", "compiled", "triton", "tiny-cuda-nn"]
BACKENDS = ("auto", "torch", "compiled", "triton", "tiny-cuda-nn")


class Evaluator(Protocol):
    """What a fast back end answers for a model, without a graph; arguments and answers are those of `Field`."""

    def evaluate(self, points: Tensor) -> Tensor:
        """Return intensities [N] at canonical points [N, 3]."""
        ...

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] at canonical points [N, 3]."""
        ...

    def axial_value_and_slope(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N]."""
        ...

    def axial_lines(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        """Return intensities [N, K] at canonical depths [N, K] along the axial lines at lateral [N], bscan [N]."""
        ...

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors."""
        ...


def why_not_compiled(model: NeuralModel) -> str:
    """Say in words why compiled kernels cannot run a model, empty if they can."""
    table = model.grid.table
    if table.device.type != "cpu":
        return f"its parameters lie on {table.device}; they are for the CPU"
    if table.dtype != torch.float32:
        return f"its parameters are {table.dtype}; they are for float32"
    if not isinstance(model.network.hidden[1], nn.ReLU):
        return f"its activation is {type(model.network.hidden[1]).__name__}; they are for ReLU"
    return "" if numba_is_there() else "numba is missing; pip install numba"


def why_not_triton(model: NeuralModel) -> str:
    """Say in words why Triton kernels cannot run a model, empty if they can."""
    return _why_not_cuda(model) or ("" if triton_is_there() else "Triton is missing; pip install triton")


def why_not_tiny_cuda_nn(model: NeuralModel, *, for_fit: bool) -> str:
    """Say in words why tiny-cuda-nn cannot run a model, empty if it can.

    Args:
        model: the model.
        for_fit: whether it may be changed to suit.
    """
    reason = _why_not_cuda(model)
    if not reason and importlib.util.find_spec("tinycudann") is None:
        reason = "tinycudann is missing; build it from https://github.com/NVlabs/tiny-cuda-nn"
    if reason:
        return reason
    from octn_ros.field.cuda.tiny_cuda_nn import is_tied, why_not_published

    reason = why_not_published(model.grid)
    if not reason and not for_fit and not is_tied(model.grid):
        reason = "its features at the far faces are its own, which tiny-cuda-nn's are not; fit it by that backend"
    return reason


def choose_backend(model: NeuralModel, backend: str, *, for_fit: bool = False) -> Backend:
    """Return the back end for a model: with "auto" the fastest that can run it on its device, else plain torch.

    A back end that is asked for by name and cannot run the model is replaced by plain torch, with a warning.

    Args:
        model: the model.
        backend: one of BACKENDS.
        for_fit: whether the model is going to be fitted, and may be changed to suit; else it is only evaluated.

    Warns:
        BackendWarning: plain torch is used although something else was asked for, or for want of a library.

    Raises:
        ConfigurationError: there is no such back end.
    """
    if backend not in BACKENDS:
        raise ConfigurationError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    if backend == "auto":
        if model.grid.table.device.type == "cuda":
            return "torch" if why_not_triton(model) else "triton"
        return "torch" if why_not_compiled(model) else "compiled"
    if backend == "compiled":
        reason = why_not_compiled(model)
        chosen: Backend = "compiled"
    elif backend == "triton":
        reason, chosen = why_not_triton(model), "triton"
    elif backend == "tiny-cuda-nn":
        reason, chosen = why_not_tiny_cuda_nn(model, for_fit=for_fit), "tiny-cuda-nn"
    else:
        return "torch"
    if reason:
        warnings.warn(
            f"backend: {backend} was asked for and cannot run this field: {reason}. Plain torch does its work",
            BackendWarning,
            stacklevel=3,
        )
        return "torch"
    return chosen


def make_evaluator(model: NeuralModel, backend: Backend) -> Evaluator | None:
    """Return what evaluates a model, None for plain torch; loads libraries, and compiles at its first use."""
    if backend == "compiled":
        from octn_ros.field.compiled.evaluator import CompiledEvaluator

        return CompiledEvaluator(model)
    if backend == "triton":
        from octn_ros.field.cuda.evaluator import TritonEvaluator

        return TritonEvaluator(model)
    if backend == "tiny-cuda-nn":
        from octn_ros.field.cuda.tiny_cuda_nn import TinyCudaEvaluator

        return TinyCudaEvaluator(model)
    return None


def make_forward(model: NeuralModel, backend: Backend) -> Callable[[Tensor], Tensor]:
    """Return what maps points [N, 3] to intensities [N] in a fit, differentiable once; the model itself for torch.

    Its parameters are the model's. For tiny-cuda-nn the model is changed to suit; for the compiled back end, whose
    kernels take their steps without such a function, it is the model too.
    """
    if backend == "triton":
        from octn_ros.field.cuda.evaluator import TritonModel

        return TritonModel(model)
    if backend == "tiny-cuda-nn":
        from octn_ros.field.cuda.tiny_cuda_nn import TinyCudaModel

        return TinyCudaModel(model)
    return model


@functools.cache
def numba_is_there() -> bool:
    """Say whether kernels can be compiled for the CPU; where not, warn once."""
    return _is_there("numba", "pip install numba")


@functools.cache
def triton_is_there() -> bool:
    """Say whether kernels can be compiled for a GPU; where not, warn once."""
    return _is_there("triton", "pip install triton")


def _is_there(library: str, remedy: str) -> bool:
    if importlib.util.find_spec(library) is not None:
        return True
    warnings.warn(
        f"{library} is not installed: fields are fitted and asked by plain torch, many times slower; {remedy}",
        BackendWarning,
        stacklevel=3,
    )
    return False


def _why_not_cuda(model: NeuralModel) -> str:
    table = model.grid.table
    # Triton's interpreter runs kernels on the CPU, for tests.
    if table.device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        return f"its parameters lie on {table.device}; it is for CUDA"
    return "" if table.dtype == torch.float32 else f"its parameters are {table.dtype}; it is for float32"
