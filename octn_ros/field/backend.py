"""Which code answers for a neural field: plain torch, the reference, or kernels compiled for the CPU."""

from __future__ import annotations

import functools
import importlib.util
import warnings
from typing import TYPE_CHECKING, Literal

import torch
from torch import nn

from octn_ros.errors import ConfigurationError

if TYPE_CHECKING:
    from octn_ros.field.compiled.evaluator import CompiledEvaluator
    from octn_ros.field.neural import NeuralModel

BACKENDS = ("auto", "torch", "compiled")


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


def choose_backend(model: NeuralModel, backend: str) -> Literal["torch", "compiled"]:
    """Return the back end for a model: with "auto" the compiled one where it can run, else plain torch.

    Raises:
        ConfigurationError: the compiled back end is asked for and cannot run the model.
    """
    if backend not in BACKENDS:
        raise ConfigurationError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    if backend == "torch":
        return "torch"
    reason = why_not_compiled(model)
    if reason and backend == "compiled":
        raise ConfigurationError(f"backend: expected a field that compiled kernels can run, but {reason}")
    return "torch" if reason else "compiled"


def make_evaluator(model: NeuralModel) -> CompiledEvaluator:
    """Return the compiled evaluator of a model; loads numba, and compiles at its first use on a machine."""
    from octn_ros.field.compiled.evaluator import CompiledEvaluator

    return CompiledEvaluator(model)


@functools.cache
def numba_is_there() -> bool:
    """Say whether kernels can be compiled; where not, warn once."""
    if importlib.util.find_spec("numba") is None:
        warnings.warn(
            "numba is not installed: fields are fitted and asked by plain torch, many times slower; pip install numba",
            RuntimeWarning,
            stacklevel=2,
        )
        return False
    return True
