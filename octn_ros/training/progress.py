"""What a running fit tells, and when."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

from octn_ros.training.config import FitConfig

REPORT_PERIOD_S = 0.25
# What a bar shows before a fit's first report: title, fraction, remark.
PREPARING = ("preparing the fit", 0.0, "the first time on a machine, kernels are compiled")
Stage = Literal["hybrid", "discrete"]


@dataclass(frozen=True)
class FitProgress:
    """Where a fit stands.

    Attributes:
        step, steps: steps done, steps planned.
        seconds: time since the start.
        fraction: share of the fit that is done, by steps or by the time budget, whichever is further.
        stage: "hybrid" or "discrete".
        loss: mean loss over the samples since the last report.
        psnr_db: on fixed voxels of evenly spaced B-scans, the same ones throughout, as last evaluated.
        samples_per_s: training samples per second so far.
    """

    step: int
    steps: int
    seconds: float
    fraction: float
    stage: Stage
    loss: float
    psnr_db: float
    samples_per_s: float


class Schedule:
    """Turns steps and seconds into the share of the fit that is done, its stage and its learning rate.

    The clock starts when the object is made. Stages are Algorithm 1's: a step t is hybrid while t <= T_hyb =
    floor(r_hyb T). Under a time budget the clock may be further than the steps; then it decides.
    """

    def __init__(self, config: FitConfig) -> None:
        self._config = config
        self._hybrid_steps = int(round(config.hybrid_share * config.steps, 6))
        self._start = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self._start

    def by_time(self) -> float:
        """Return the share of the time budget that is spent, 0 without one."""
        return self.seconds / self._config.time_budget_s if self._config.time_budget_s > 0 else 0.0

    def fraction(self, steps_done: int) -> float:
        """Return the share of the fit that is done, at most 1."""
        return min(max(steps_done / self._config.steps, self.by_time()), 1.0)

    def stage(self, step: int) -> Stage:
        """Return the stage of the step of that number, counted from 1."""
        hybrid = step <= self._hybrid_steps and self.by_time() < self._config.hybrid_share
        return "hybrid" if hybrid else "discrete"

    def learning_rate(self, fraction: float) -> float:
        """Return the learning rate: an exponential fall from the first to the last."""
        return self._config.learning_rate * self._config.final_rate_ratio**fraction


class ProgressTally:
    """Averages losses between reports."""

    def __init__(self, config: FitConfig, schedule: Schedule) -> None:
        self._config, self._schedule = config, schedule
        self._last_s = 0.0
        self._losses: list[float] = []

    def add(self, loss: float) -> None:
        """Take the loss of one step."""
        self._losses.append(loss)

    def report(
        self, step: int, samples: int, stage: Stage, psnr_db: float, *, last: bool = False
    ) -> FitProgress | None:
        """Return a report about four times a second, and of what is left after the last step."""
        seconds = self._schedule.seconds
        if not self._losses or (seconds - self._last_s < REPORT_PERIOD_S and not last):
            return None
        self._last_s = seconds
        mean = sum(self._losses) / len(self._losses)
        self._losses = []
        return FitProgress(
            step=step,
            steps=self._config.steps,
            seconds=seconds,
            fraction=self._schedule.fraction(step),
            stage=stage,
            loss=mean,
            psnr_db=psnr_db,
            samples_per_s=samples / seconds,
        )
