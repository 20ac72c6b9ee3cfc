"""Who does the steps of a fit: chosen by objective, back end and kind of samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from torch import Tensor, nn

from octn_ros.field import NeuralModel
from octn_ros.field.backend import Backend, choose_backend, make_forward
from octn_ros.training.config import FitConfig
from octn_ros.training.neighbour_trainer import NeighbourTrainer
from octn_ros.training.point_trainer import PointTrainer
from octn_ros.training.sampling import ResidentVoxels, VoxelSampler
from octn_ros.training.tissue_sheet import TissueSheet
from octn_ros.volume import Volume


class Trainer(Protocol):
    """Fits a model in place, step by step.

    Attributes:
        samples: how many were used so far.
        trained: what the steps change.
    """

    samples: int
    trained: nn.Module

    def step(self, rate: float, alpha: float, cancelled: Callable[[], bool]) -> Tensor | float | None:
        """Do one step; return its mean squared error, None if it was cancelled and nothing has changed."""
        ...

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the model's intensities [N] at canonical points [N, 3], without a graph."""
        ...


def backend_of_fit(model: NeuralModel, config: FitConfig) -> Backend:
    """Return the back end that takes the steps of a fit.

    Warns:
        BackendWarning: the one asked for cannot run the model; plain torch does.
    """
    if config.objective == "neighbours":
        return "torch"
    if config.backend == "auto" and not config.bricks and model.grid.table.device.type == "cpu":
        return "torch"
    return choose_backend(model, config.backend, for_fit=True)


def make_trainer(
    model: NeuralModel,
    volume: Volume,
    voxels: ResidentVoxels,
    config: FitConfig,
    backend: Backend,
    cancelled: Callable[[], bool],
    *,
    sheet: TissueSheet | None,
    warm: bool,
) -> Trainer:
    """Return what fits a model.

    Args:
        model: the model in its first state.
        volume: the C-scan.
        voxels: the same on the model's device.
        config: parameters of Algorithm 1.
        backend: that of `backend_of_fit`.
        cancelled: asked while the trainer is made.
        sheet: what the tissue follows, which learning from neighbours needs; None for the other objective.
        warm: whether the model has been fitted to a scan like this one.
    """
    if sheet is not None:
        return NeighbourTrainer(model, volume, sheet, config.batch, config.seed, cancelled, keep_network=warm)
    if backend == "compiled":
        # Loaded here, since it brings numba along.
        from octn_ros.training.brick_trainer import BrickTrainer

        return BrickTrainer(model, volume, config.batch, config.seed)
    forward = make_forward(model, backend)
    return PointTrainer(model, VoxelSampler(voxels, config.seed), config.batch, forward)
