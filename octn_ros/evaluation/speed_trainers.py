"""What takes the steps of a fit: plain torch, torch.compile and the fused kernels, at the same configuration."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from octn_ros.field import NeuralFieldConfig, NeuralModel
from octn_ros.training import FitConfig, ResidentVoxels, VoxelSampler
from octn_ros.training.data_start import start_from_data
from octn_ros.training.held_in import HeldInVoxels
from octn_ros.training.point_trainer import PointTrainer
from octn_ros.training.sampling import interpolated_count
from octn_ros.volume import Volume


class Stepper(Protocol):
    """What takes steps; `samples` counts those drawn so far."""

    samples: int

    def step(self, rate: float, alpha: float, cancelled: Callable[[], bool]) -> Tensor | float | None:
        """Do one step; return its loss."""
        ...


class CompiledTorchTrainer:
    """Algorithm 1's steps with everything between the random numbers and the gradients in one torch.compile'd graph.

    The graph looks up and interpolates voxels, encodes, runs the network and forms the loss; shapes are static and
    breaks in the graph an error. Adam is torch's own fused kernel, as in the plain path. Not thread-safe.

    Args:
        model: the model that is trained.
        voxels: the C-scan.
        batch: samples of a step.
        seed: of the samples.
        mode: of torch.compile.
    """

    def __init__(self, model: NeuralModel, voxels: ResidentVoxels, batch: int, seed: int, mode: str) -> None:
        self._voxels, self._batch = voxels, batch
        self._generator = torch.Generator(device=voxels.device).manual_seed(seed)
        self._optimizer = torch.optim.Adam(model.parameters(), betas=(0.9, 0.99), eps=1e-15, fused=True)
        self.samples = 0
        for level in model.grid.grid_levels:
            # Worked out in Python here, since the graph cannot.
            _ = level.factors

        def loss(flat: Tensor, unit: Tensor) -> Tensor:
            between = unit * 2.0 - 1.0
            points = torch.cat((voxels.points(flat), between))
            intensities = torch.cat((voxels.at(flat), voxels.interpolate(between)))
            return nn.functional.mse_loss(model(points), intensities)

        # A model compiled before, of another shape, must not make this one's shapes dynamic.
        torch.compiler.reset()
        self._loss = torch.compile(loss, dynamic=False, fullgraph=True, mode=mode)

    def step(self, rate: float, alpha: float, cancelled: Callable[[], bool]) -> Tensor | None:
        """Do one step; the first of each share `alpha` compiles."""
        if cancelled():
            return None
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        interpolated, device = interpolated_count(self._batch, alpha), self._voxels.device
        flat = torch.randint(len(self._voxels), (self._batch - interpolated,), generator=self._generator, device=device)
        loss = self._loss(flat, torch.rand(interpolated, 3, generator=self._generator, device=device))
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._optimizer.step()
        self.samples += self._batch
        return loss.detach()


@dataclass(frozen=True, eq=False)
class Start:
    """A model before its first step.

    Attributes:
        model: the model.
        shape: what it was made with.
        voxels: the C-scan on the model's device.
        seconds: what it took to make them, from the array on.
    """

    model: NeuralModel
    shape: NeuralFieldConfig
    voxels: ResidentVoxels
    seconds: float


def start_model(volume: Volume, config: FitConfig, device: str) -> Start:
    """Make the model that a fit of this configuration begins with, as `fit` does."""
    began = time.perf_counter()
    voxels = ResidentVoxels(volume, torch.device(device))
    shape = config.field.for_volume(volume.geometry)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = NeuralModel(shape, volume.geometry.shape)
    if config.start_from_data:
        start_from_data(model, volume, _never)
    else:
        nn.init.constant_(model.network.output.bias, HeldInVoxels(voxels).mean)
    return Start(model.to(device), shape, voxels, time.perf_counter() - began)


def make_stepper(way: str, start: Start, volume: Volume, config: FitConfig, mode: str = "default") -> Stepper:
    """Return what takes the steps one of `WAYS`; fused is what the preset uses on the device of the model."""
    if way == "compile":
        return CompiledTorchTrainer(start.model, start.voxels, config.batch, config.seed, mode)
    if way == "fused" and start.voxels.device.type == "cpu":
        # Loaded here, since it brings numba along.
        from octn_ros.training.brick_trainer import BrickTrainer

        return BrickTrainer(start.model, volume, config.batch, config.seed)
    forward = None
    if way == "fused":
        from octn_ros.field.backend import choose_backend, make_forward

        forward = make_forward(start.model, choose_backend(start.model, "auto", for_fit=True))
    return PointTrainer(start.model, VoxelSampler(start.voxels, config.seed), config.batch, forward)


def compile_steps(stepper: Stepper, config: FitConfig) -> float:
    """Do a step at rate 0 with every share of interpolated samples to come; return the seconds, mostly of compiling."""
    began = time.perf_counter()
    for alpha in (config.alpha, 0.0) if config.hybrid_share < 1.0 else (config.alpha,):
        stepper.step(0.0, alpha, _never)
    stepper.samples = 0
    return time.perf_counter() - began


def samples_per_s(stepper: Stepper, config: FitConfig, seconds: float) -> float:
    """Return how many samples a second a warm stepper trains on, over at least `seconds` and three steps."""
    _finish(stepper.step(config.learning_rate, config.alpha, _never))
    before, steps, began = stepper.samples, 0, time.perf_counter()
    while steps < 3 or time.perf_counter() - began < seconds:
        loss = stepper.step(config.learning_rate, config.alpha, _never)
        steps += 1
    _finish(loss)
    return (stepper.samples - before) / (time.perf_counter() - began)


def train_to(samples: int, stepper: Stepper, config: FitConfig, all_samples: int) -> None:
    """Do the steps of a fit of `all_samples`, whose rate and stages follow the samples, until `samples` are drawn."""
    while stepper.samples < samples:
        share = stepper.samples / all_samples
        rate = config.learning_rate * config.final_rate_ratio**share
        stepper.step(rate, config.alpha if share < config.hybrid_share else 0.0, _never)


def _finish(loss: Tensor | float | None) -> None:
    """Wait for the device: reading a loss does."""
    if loss is not None:
        float(loss)


def _never() -> bool:
    return False
