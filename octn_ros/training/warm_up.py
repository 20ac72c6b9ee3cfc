"""Compiling ahead: what the first fit and the first query of a process would otherwise wait for."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import torch

from octn_ros.field import FieldDescription, NeuralField, NeuralFieldConfig, NeuralModel
from octn_ros.training.config import PRESETS, FitConfig
from octn_ros.training.resampling import resampled
from octn_ros.training.sampling import ResidentVoxels
from octn_ros.training.trainer import backend_of_fit, make_trainer
from octn_ros.volume import Volume

_SHAPE = (16, 16, 16)
_VOXEL_TYPES = (np.uint8, np.uint16, np.float32)  # a kernel is compiled for each
_LOG2_ROWS = 10  # kernels do not depend on the size of the tables
_SAMPLES = 512  # nor on that of a batch


def warm_up(config: FitConfig, device: str | torch.device = "cpu") -> None:
    """Compile, or load from the cache, the kernels that fits use, and those of `warm_up_queries`.

    Takes some 10 s on a machine's first run, about one later; where plain torch does the work there is nothing to do.
    Makes trainers, which compile what they need, for volumes of 16 x 16 x 16 voxels of each type: neither the global
    random generator nor anything else that a fit in another thread uses is touched, but the compiler, for which it
    waits.
    Never raises: what goes wrong here is logged at debug level, and goes wrong again, in words, where it matters.
    """
    try:
        field = _made_field(config.field, torch.device(device))
        backend = backend_of_fit(field.model, config)
        if config.objective == "neighbours":
            line = np.zeros((1, 2, 1), np.float32)
            resampled(line, line[0, :, 0], line[:, 0])
        elif backend in ("compiled", "triton"):
            field.model.requires_grad_(True)
            small = dataclasses.replace(config, batch=_SAMPLES, alpha=0.0)
            for voxel_type in _VOXEL_TYPES:
                volume = _made_volume(voxel_type)
                voxels = ResidentVoxels(volume, field.device)
                trainer = make_trainer(field.model, volume, voxels, small, backend, _never, sheet=None, warm=False)
            trainer.step(config.learning_rate, 0.0, _never)
            field.model.requires_grad_(False)
        _ask(field)
    except Exception:
        logging.getLogger(__name__).debug("the kernels of fits could not be compiled ahead", exc_info=True)


def warm_up_queries(config: NeuralFieldConfig | None = None, device: str | torch.device = "cpu") -> None:
    """Compile, or load from the cache, the kernels that answer for fields; see `warm_up`.

    Args:
        config: shape of the fields to come; None for that of the preset `fast`. The same kernels run others too.
        device: where they will lie.
    """
    try:
        _ask(_made_field(config or PRESETS["fast"].field, torch.device(device)))
    except Exception:
        logging.getLogger(__name__).debug("the kernels of queries could not be compiled ahead", exc_info=True)


def _ask(field: NeuralField) -> None:
    if field.backend != "torch":
        axis = torch.linspace(-1.0, 1.0, 2, device=field.device)
        field.lattice(axis, axis, axis)
        field.evaluate(axis.new_zeros(1, 3))
        field.value_and_gradient(axis.new_zeros(1, 3))
        field.axial_lines(axis, axis, axis[:, None])
        field.axial_value_and_slope(axis, axis, axis)


def _never() -> bool:
    """Nobody cancels."""
    return False


def _made_field(config: NeuralFieldConfig, device: torch.device) -> NeuralField:
    volume = _made_volume(np.uint8)
    grid = dataclasses.replace(config.grid, log2_table_size=_LOG2_ROWS)
    small = NeuralFieldConfig(grid, config.network)
    # Made without values, so that nothing is drawn from the generator that seeds the fits.
    with torch.device("meta"):
        model = NeuralModel(small, volume.geometry.shape)
    model = model.to_empty(device=device)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    return NeuralField(model, small, FieldDescription.of_volume(volume, "neural"))


def _made_volume(voxel_type: type[np.generic]) -> Volume:
    ramp = np.arange(np.prod(_SHAPE)).reshape(_SHAPE) % 251
    return Volume.from_array(ramp.astype(voxel_type), (1e-5, 1e-5, 1e-5))
