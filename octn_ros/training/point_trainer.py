"""Steps of Algorithm 1 on lone samples, by automatic differentiation on any device: the reference."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from octn_ros.field import NeuralModel
from octn_ros.training.sampling import VoxelSampler


class PointTrainer:
    """Fits a model in place by automatic differentiation and Adam; not thread-safe itself.

    Args:
        model: the model that is trained.
        sampler: where its samples come from.
        batch: samples of a step.
        forward: the model as a function that is faster to differentiate; None for the model itself.
    """

    def __init__(
        self,
        model: NeuralModel,
        sampler: VoxelSampler,
        batch: int,
        forward: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        self._forward, self._sampler, self._batch = forward or model, sampler, batch
        # Features that no sample touches keep a zero gradient; tiny-cuda-nn's small epsilon lets rare ones move at
        # once.
        self._optimizer = torch.optim.Adam(model.parameters(), betas=(0.9, 0.99), eps=1e-15, fused=True)
        self.trained: nn.Module = model
        self.samples = 0

    def step(self, rate: float, alpha: float, cancelled: Callable[[], bool]) -> Tensor | None:
        """Do one step; return its mean squared error [], None if it was cancelled and nothing has changed.

        On a GPU it returns before the device has done the step, and reads nothing from it.

        Args:
            rate: Adam's learning rate.
            alpha: share of interpolated samples.
            cancelled: asked before the step and before anything changes.
        """
        if cancelled():
            return None
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        points, intensities = self._sampler.batch(self._batch, alpha)
        loss = nn.functional.mse_loss(self._forward(points), intensities)
        if cancelled():
            return None
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._optimizer.step()
        self.samples += self._batch
        return loss.detach()

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the model's intensities [N] at canonical points [N, 3], without a graph."""
        return without_graph(self._forward)(points)


def without_graph(forward: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Return the same function of canonical points [N, 3], but it keeps no graph."""

    def evaluate(points: Tensor) -> Tensor:
        with torch.no_grad():
            return forward(points)

    return evaluate
