"""The two-stage fit of a neural field to a C-scan (Algorithm 1)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Literal

import torch
from torch import nn

from octn_ros.errors import TrainingError
from octn_ros.field import FieldDescription, NeuralField, NeuralModel
from octn_ros.metrics import psnr_db
from octn_ros.training.config import FitConfig
from octn_ros.training.sampling import VoxelSampler
from octn_ros.volume import Volume

REPORT_PERIOD_S = 0.25
# The paper evaluates its training curve on 16 evenly spaced B-scans (fig. 7a).
EVALUATED_BSCANS = 16


@dataclass(frozen=True)
class FitProgress:
    """Where a fit stands.

    Attributes:
        step, steps: steps done, steps planned.
        seconds: time since the start.
        fraction: share of the fit that is done, by steps or by the time budget, whichever is further.
        stage: "hybrid" or "discrete".
        loss: mean squared error over the samples since the last report.
        psnr_db: the same over native voxels only, drawn at random and not yet trained on in their step.
        samples_per_s: training samples per second so far.
    """

    step: int
    steps: int
    seconds: float
    fraction: float
    stage: Literal["hybrid", "discrete"]
    loss: float
    psnr_db: float
    samples_per_s: float


@dataclass(frozen=True)
class FitResult:
    """A fitted field and how it came about.

    Attributes:
        field: the field; its description holds the configuration and these figures.
        steps: gradient steps done.
        seconds: duration of the fit, without the evaluation after it.
        psnr_db: against the measured volume on `EVALUATED_BSCANS` evenly spaced B-scans; NaN if cancelled, since
            whoever cancels a fit wants it to end.
        history: the reports of the fit.
        cancelled: whether it was stopped from outside; the field is then the unfinished one.
    """

    field: NeuralField
    steps: int
    seconds: float
    psnr_db: float
    history: tuple[FitProgress, ...]
    cancelled: bool


def fit(
    volume: Volume,
    config: FitConfig,
    *,
    device: str | torch.device = "cpu",
    progress: Callable[[FitProgress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> FitResult:
    """Fit a neural field to a volume.

    Runs in the calling thread; several fits may run in several threads. On the CPU the same seed gives the same field,
    unless a time budget is set: learning rate and stages then follow the clock.

    Args:
        volume: the C-scan.
        config: parameters of Algorithm 1.
        device: where the volume is kept and the model trained.
        progress: called about four times a second from this thread.
        cancelled: asked before every step; True ends the fit.

    Raises:
        TrainingError: the loss is no longer finite.
    """
    device = torch.device(device)
    model = _seeded_model(config, volume).to(device)
    sampler = VoxelSampler(volume, device, config.seed)
    # Features that no sample touches keep a zero gradient; tiny-cuda-nn's small epsilon lets rare ones move at once.
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate, betas=(0.9, 0.99), eps=1e-15, fused=True)
    history: list[FitProgress] = []
    start = time.perf_counter()
    tally = _Tally(config, start)
    step, stopped = 0, False
    while step < config.steps:
        fraction = _fraction(config, step, time.perf_counter() - start)
        if fraction >= 1.0:
            break
        if cancelled is not None and cancelled():
            stopped = True
            break
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * config.final_rate_ratio**fraction
        hybrid = fraction < config.hybrid_share
        points, intensities, voxels = sampler.batch(config.batch, config.alpha if hybrid else 0.0)
        error = (model(points) - intensities).square()
        loss = error.mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        step += 1
        tally.add(float(loss.detach()), float(error.detach()[:voxels].mean()) if voxels else math.nan)
        report = tally.report(step, "hybrid" if hybrid else "discrete", last=step == config.steps)
        if report is not None:
            history.append(report)
            if progress is not None:
                progress(report)
    seconds = time.perf_counter() - start
    field = NeuralField(model, config.field, FieldDescription.of_volume(volume, "neural"))
    quality = math.nan if stopped else psnr_of_field(field, volume)
    training = {
        "config": asdict(config),
        "steps": step,
        "seconds": seconds,
        "psnr_db": None if stopped else quality,
        "cancelled": stopped,
    }
    field = NeuralField(model, config.field, replace(field.description, training=training))
    return FitResult(field, step, seconds, quality, tuple(history), stopped)


def psnr_of_field(field: NeuralField, volume: Volume, bscans: int = EVALUATED_BSCANS) -> float:
    """Return the PSNR in dB of a field against a volume's voxels, on `bscans` evenly spaced B-scans (all if fewer)."""
    count = volume.geometry.shape[0]
    chosen = torch.linspace(0, count - 1, min(bscans, count)).round().long()
    axes = [torch.linspace(-1.0, 1.0, n, device=field.device) for n in volume.geometry.shape]
    rendered = field.lattice(axes[2], axes[1], axes[0][chosen.to(field.device)])
    return psnr_db(volume.normalized()[chosen.numpy()], rendered.cpu().numpy())


def _seeded_model(config: FitConfig, volume: Volume) -> NeuralModel:
    # Parameters are drawn by torch's global generator; fork it, so that a fit leaves the caller's random state alone.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = NeuralModel(config.field, volume.geometry.shape)
    # Start from the volume's mean: the first steps then go into tissue instead of into a constant.
    nn.init.constant_(model.network.output.bias, float(volume.normalized().mean()))
    return model


def _fraction(config: FitConfig, step: int, seconds: float) -> float:
    by_time = seconds / config.time_budget_s if config.time_budget_s > 0 else 0.0
    return max(step / config.steps, by_time)


class _Tally:
    """Sums losses between reports."""

    def __init__(self, config: FitConfig, start: float) -> None:
        self._config, self._start, self._last = config, start, start
        self._losses: list[float] = []
        self._voxel_errors: list[float] = []

    def add(self, loss: float, voxel_error: float) -> None:
        if not math.isfinite(loss):
            raise TrainingError(
                f"the loss became {loss}: the fit diverged; lower the learning rate {self._config.learning_rate:g}"
            )
        self._losses.append(loss)
        self._voxel_errors.append(voxel_error)

    def report(self, step: int, stage: Literal["hybrid", "discrete"], last: bool) -> FitProgress | None:
        now = time.perf_counter()
        if now - self._last < REPORT_PERIOD_S and not last:
            return None
        self._last = now
        seconds = now - self._start
        loss = sum(self._losses) / len(self._losses)
        voxel_error = sum(self._voxel_errors) / len(self._voxel_errors)
        self._losses, self._voxel_errors = [], []
        return FitProgress(
            step=step,
            steps=self._config.steps,
            seconds=seconds,
            fraction=min(_fraction(self._config, step, seconds), 1.0),
            stage=stage,
            loss=loss,
            psnr_db=-10.0 * math.log10(voxel_error) if voxel_error > 0 else math.inf,
            samples_per_s=step * self._config.batch / seconds,
        )
