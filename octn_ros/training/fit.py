"""The two-stage fit of a neural field to a C-scan (Algorithm 1)."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from octn_ros.errors import TrainingError
from octn_ros.field import FieldDescription, NeuralField, NeuralModel
from octn_ros.metrics import psnr_from_error_db
from octn_ros.settings import as_plain
from octn_ros.training.config import FitConfig
from octn_ros.training.data_start import follow_data, start_from_data
from octn_ros.training.divergence import DivergenceGuard
from octn_ros.training.held_in import HeldInVoxels, psnr_of_field
from octn_ros.training.losses import LossReader
from octn_ros.training.noise import noise_variance
from octn_ros.training.point_trainer import without_graph
from octn_ros.training.progress import FitProgress, ProgressTally, Schedule, Stage
from octn_ros.training.sampling import ResidentVoxels
from octn_ros.training.tissue_sheet import TissueSheet
from octn_ros.training.trainer import Trainer, backend_of_fit, make_trainer
from octn_ros.volume import Volume

_SEEDING = threading.Lock()
Ended = Literal["steps", "time", "target", "noise level", "cancelled", "diverged"]


@dataclass(frozen=True)
class FitResult:
    """A fitted field and how it came about.

    Attributes:
        field: the field; its description holds the configuration and these figures.
        steps: gradient steps behind the field.
        seconds: duration of the fit, without the evaluation after it.
        psnr_db: against the measured volume on evenly spaced B-scans; NaN if cancelled, since whoever cancels a fit
            wants it to end.
        history: the reports of the fit.
        ended: why it ended: all "steps" done, "time" budget spent, "target" PSNR reached, error down to the "noise
            level", "cancelled" from outside (the field is then unfinished) or "diverged" (the field is then the last
            good one).
    """

    field: NeuralField
    steps: int
    seconds: float
    psnr_db: float
    history: tuple[FitProgress, ...]
    ended: Ended

    @property
    def cancelled(self) -> bool:
        """Whether it was stopped from outside."""
        return self.ended == "cancelled"


def fit(
    volume: Volume,
    config: FitConfig,
    *,
    device: str | torch.device = "cpu",
    progress: Callable[[FitProgress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    start: NeuralField | None = None,
) -> FitResult:
    """Fit a neural field to a volume.

    Runs in the calling thread; several fits may run in several threads. On the CPU the same seed gives the same field
    for the same number of threads, unless a time budget is set: learning rate and stages then follow the clock. On a
    GPU it does so up to the rounding of sums taken in any order, which training lets grow. There volume, samples,
    model and losses stay on the device, and no step waits for it.

    Args:
        volume: the C-scan.
        config: parameters of Algorithm 1.
        device: where the volume is kept and the model trained.
        progress: called about four times a second from this thread.
        cancelled: asked before and within every step, and throughout the evaluation at the end; True ends the fit.
        start: a field fitted before to a scan of the same shape and spacing; the fit begins with its parameters and
            keeps its shape, whatever `config.field` says. None begins anew.

    Returns:
        The field and why the fit ended. A fit that diverged returns its last good state.

    Raises:
        TrainingError: the fit diverged before there was a good state, or `start` does not fit the volume.
    """
    device = torch.device(device)
    is_cancelled = cancelled or _never
    voxels = ResidentVoxels(volume, device)
    held_in = HeldInVoxels(voxels)
    sheet = TissueSheet.of(volume, is_cancelled) if config.objective == "neighbours" else None
    if start is not None:
        config = dataclasses.replace(config, field=start.config)
        model = _model_of(start, volume).to(device)
        if config.start_from_data and config.objective == "voxels":
            follow_data(
                model, volume, start, lambda here: held_in.mean_squared_error(without_graph(here)), is_cancelled
            )
    else:
        field_config = config.field.for_volume(volume.geometry)
        if sheet is not None:
            cells = sheet.cells_per_bscan(field_config.grid.cells_per_bscan, volume.geometry.shape[1])
            field_config = dataclasses.replace(
                field_config, grid=dataclasses.replace(field_config.grid, cells_per_bscan=cells)
            )
        config = dataclasses.replace(config, field=field_config)
        model = _seeded_model(config, volume, held_in.mean)
        if config.start_from_data and config.objective == "voxels":
            start_from_data(model, volume, is_cancelled)
        model = model.to(device)
    backend = backend_of_fit(model, config)
    trainer = make_trainer(model, volume, voxels, config, backend, is_cancelled, sheet=sheet, warm=start is not None)
    steps, seconds, history, ended = _train(voxels, trainer, held_in, config, progress or _ignore, is_cancelled)
    field = NeuralField(model, config.field, FieldDescription.of_volume(volume, "neural"))
    quality = math.nan if ended == "cancelled" else psnr_of_field(field, volume, cancelled=is_cancelled)
    if math.isnan(quality):
        ended = "cancelled"
    training = {
        "config": as_plain(config),
        "steps": steps,
        "samples": trainer.samples,
        "seconds": seconds,
        "psnr_db": None if math.isnan(quality) else quality,
        "ended": ended,
        "backend": backend,
        "warm_start": start is not None,
    }
    field = NeuralField(model, config.field, dataclasses.replace(field.description, training=training))
    return FitResult(field, steps, seconds, quality, history, ended)


def _train(
    voxels: ResidentVoxels,
    trainer: Trainer,
    held_in: HeldInVoxels,
    config: FitConfig,
    progress: Callable[[FitProgress], None],
    cancelled: Callable[[], bool],
) -> tuple[int, float, tuple[FitProgress, ...], Ended]:
    """Train in place; return steps, seconds, reports and why it ended."""
    guard = DivergenceGuard(trainer.trained, held_in.variance)
    period = HeldInVoxels.period(config.batch)
    noise = noise_variance(voxels) if config.stop_at_noise else -1.0
    schedule = Schedule(config)
    tally = ProgressTally(config, schedule)
    losses = LossReader(voxels.device)
    history: list[FitProgress] = []

    def tell(report: FitProgress | None) -> None:
        if report is not None:
            history.append(report)
            progress(report)

    def reached() -> Ended | None:
        guard.keep(step, error)
        if config.target_psnr_db > 0 and psnr_from_error_db(error) >= config.target_psnr_db:
            return "target"
        return "noise level" if error <= noise else None

    def diverged(read: list[float]) -> bool:
        for loss in read:
            if guard.diverged(loss):
                return True
            tally.add(loss)
        return False

    step, error = 0, held_in.mean_squared_error(trainer.evaluate)
    stage: Stage = "hybrid"
    ended: Ended | None = reached()
    while ended is None:
        fraction = schedule.fraction(step)
        if fraction >= 1.0:
            ended = "steps" if step == config.steps else "time"
            break
        stage = schedule.stage(step + 1)
        alpha = config.alpha if stage == "hybrid" else 0.0
        loss = trainer.step(schedule.learning_rate(fraction), alpha, cancelled)
        if loss is None:
            ended = "cancelled"
            break
        step += 1
        evaluated = step % period == 0 or step == config.steps
        if diverged(losses.add(loss) + (losses.read() if evaluated else [])):
            ended = "diverged"
            break
        if evaluated:
            error = held_in.mean_squared_error(trainer.evaluate)
            ended = reached()
        last = ended is not None or step == config.steps
        tell(tally.report(step, trainer.samples, stage, psnr_from_error_db(error), last=last))
    if ended == "time":  # at every other good end the last step was evaluated
        error = held_in.mean_squared_error(trainer.evaluate)
        ended = "diverged" if diverged(losses.read()) else ended
    if ended in ("steps", "time", "target", "noise level") and not math.isfinite(error):
        ended = "diverged"
    seconds = schedule.seconds
    if ended != "diverged":
        tell(tally.report(step, trainer.samples, stage, psnr_from_error_db(error), last=True))
    else:
        good = guard.restore()
        if good is None:
            raise TrainingError(
                f"the fit diverged in step {step} and had no good state before; "
                f"lower the learning rate {config.learning_rate:g}"
            )
        step = good
    return step, seconds, tuple(history), ended


def _seeded_model(config: FitConfig, volume: Volume, mean: float) -> NeuralModel:
    # Parameters are drawn by torch's global generator: one fit at a time, and the caller's random state is put back.
    with _SEEDING, torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = NeuralModel(config.field, volume.geometry.shape)
    # Start from the volume's mean: the first steps then go into tissue instead of into a constant.
    nn.init.constant_(model.network.output.bias, mean)
    return model


def _model_of(start: NeuralField, volume: Volume) -> NeuralModel:
    """Return a trainable copy of a field's model."""
    there, here = start.geometry, volume.geometry
    if not there.same_grid(here):
        raise TrainingError(
            f"expected a start field of the volume's shape {here.shape} and spacing {here.spacing_m} m, got one of "
            f"{there.shape} and {there.spacing_m} m; fit anew without it"
        )
    model = NeuralModel(start.config, here.shape)
    model.load_state_dict(start.model.state_dict())
    return model.requires_grad_(True).train()


def _ignore(report: FitProgress) -> None:
    """Tell nobody."""


def _never() -> bool:
    """Nobody cancels."""
    return False
