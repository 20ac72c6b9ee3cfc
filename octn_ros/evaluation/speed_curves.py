"""PSNR against seconds: how soon a fit is as near to the truth as a Gaussian of one voxel."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.evaluation.speed_trainers import Start, Stepper, compile_steps, make_stepper, start_model
from octn_ros.field import FieldDescription, NeuralField
from octn_ros.metrics import psnr_from_error_db
from octn_ros.simulation import Phantom, PhantomConfig, make_phantom
from octn_ros.training import FitConfig
from octn_ros.volume import Volume, gaussian_filter

# PSNR along a curve is taken on this many evenly spaced B-scans, each time at the clock's standstill.
_CURVE_BSCANS = 16
_FIRST_S, _GROWTH = 0.25, 1.3


@dataclass(frozen=True, eq=False)
class Yardstick:
    """A phantom and how near a Gaussian of one voxel comes to its truth.

    Attributes:
        phantom: the phantom.
        gaussian_db: PSNR of its volume after the Gaussian against the truth, all voxels.
        on_curve_db: the same on the B-scans that curves are taken on, where it is the quality to be reached.
        gaussian_s: what the Gaussian took.
    """

    phantom: Phantom
    gaussian_db: float
    on_curve_db: float
    gaussian_s: float


@dataclass(frozen=True)
class CurvePoint:
    """Where a fit stands: seconds of its clock, samples, PSNR against the truth and the measured voxels."""

    seconds: float
    samples: int
    truth_db: float
    noisy_db: float


@dataclass(frozen=True)
class Curve:
    """One fit's PSNR against its seconds.

    Attributes:
        way: what took the steps.
        start: "data" or "mean".
        points: in order of time; the first before any step.
        budget_s: over which the learning rate fell.
        compile_s: compiling, which the seconds leave out.
        reached_s: when the quality asked for was seen first, NaN if it was not.
    """

    way: str
    start: str
    points: tuple[CurvePoint, ...]
    budget_s: float
    compile_s: float
    reached_s: float


def yardstick(shape: tuple[int, int, int], seed: int) -> Yardstick:
    """Make the `averaged` phantom of a shape and measure the Gaussian on it."""
    phantom = make_phantom(PhantomConfig(shape=shape, seed=seed))
    began = time.perf_counter()
    smooth = gaussian_filter(phantom.volume, 1.0)
    seconds = time.perf_counter() - began
    whole, some = (volume_psnr(smooth, phantom.truth, bscans) for bscans in (all_bscans(smooth), curve_bscans(smooth)))
    return Yardstick(phantom, whole, some, seconds)


def volume_psnr(volume: Volume, truth: Volume, bscans: NDArray[np.int64]) -> float:
    """Return the PSNR in dB of a volume's intensities against another's, at all voxels of some B-scans."""
    total = 0.0
    for bscan in bscans.tolist():
        difference = volume.normalized((bscan,)).astype(np.float64) - truth.normalized((bscan,))
        total += float(np.vdot(difference, difference))
    return psnr_from_error_db(total / (len(bscans) * truth.array[0].size))


def field_psnr(field: NeuralField, volumes: tuple[Volume, ...], bscans: NDArray[np.int64]) -> list[float]:
    """Return the PSNR in dB of a field against each of some volumes of its shape, at all voxels of some B-scans."""
    _, axials, laterals = field.geometry.shape
    bscan, axial, lateral = (torch.linspace(-1.0, 1.0, n, device=field.device) for n in field.geometry.shape)
    totals = np.zeros(len(volumes))
    for part in np.array_split(bscans, math.ceil(len(bscans) / 8)):
        rendered = field.lattice(lateral, axial, bscan[torch.from_numpy(part)]).cpu().numpy()
        for plane, index in zip(rendered, part.tolist(), strict=True):
            for place, volume in enumerate(volumes):
                difference = plane.astype(np.float64) - volume.normalized((index,))
                totals[place] += float(np.vdot(difference, difference))
    return [psnr_from_error_db(total / (len(bscans) * axials * laterals)) for total in totals]


def all_bscans(volume: Volume) -> NDArray[np.int64]:
    """Return the numbers of all B-scans."""
    return np.arange(volume.geometry.shape[0])


def curve(
    way: str,
    start: str,
    config: FitConfig,
    against: Yardstick,
    device: str,
    budget_s: float,
    *,
    stop_when_reached: bool,
) -> Curve:
    """Fit with the clock running and look at the field now and then, while it stands still.

    The clock begins with the array: making the model and its start from the data count, compiling does not. The
    learning rate and the two stages follow the clock over `budget_s`.

    Args:
        way: one of `WAYS`.
        start: its name in the answer.
        config: how it is fitted.
        against: phantom, and the quality to be reached.
        device: where.
        budget_s: when the fit ends.
        stop_when_reached: end it as soon as the quality is seen.
    """
    phantom = against.phantom
    began = start_model(phantom.volume, config, device)
    points = [_look(began, None, phantom, began.seconds)]
    reached = points[0].seconds if points[0].truth_db >= against.on_curve_db else math.nan
    if stop_when_reached and not math.isnan(reached):
        return Curve(way, start, tuple(points), budget_s, 0.0, reached)
    making = time.perf_counter()
    stepper = make_stepper(way, began, phantom.volume, config)
    # Kernels are compiled, or loaded, when the trainer is made; torch's with the first steps.
    compile_s = time.perf_counter() - making + compile_steps(stepper, config)
    clock, due = began.seconds, began.seconds + _FIRST_S
    while clock < budget_s:
        stretch = time.perf_counter()
        while clock + time.perf_counter() - stretch < min(due, budget_s):
            share = (clock + time.perf_counter() - stretch) / budget_s
            rate = config.learning_rate * config.final_rate_ratio**share
            stepper.step(rate, config.alpha if share < config.hybrid_share else 0.0, _never)
        if device != "cpu":
            torch.cuda.synchronize(device)
        clock += time.perf_counter() - stretch
        due = clock * _GROWTH + 0.01
        points.append(_look(began, stepper, phantom, clock))
        if math.isnan(reached) and points[-1].truth_db >= against.on_curve_db:
            reached = clock
            if stop_when_reached:
                break
    return Curve(way, start, tuple(points), budget_s, compile_s, reached)


def time_to_quality(
    way: str, start: str, config: FitConfig, against: Yardstick, device: str, budgets_s: tuple[float, ...]
) -> Curve:
    """Return the first curve, of those with growing budgets, that reaches the Gaussian's quality; else the last."""
    tried: Iterator[Curve] = (
        curve(way, start, config, against, device, budget, stop_when_reached=True) for budget in budgets_s
    )
    for last in tried:
        if not math.isnan(last.reached_s):
            break
    return last


def curve_bscans(volume: Volume) -> NDArray[np.int64]:
    """Return the evenly spaced B-scans that curves are taken on."""
    bscans = volume.geometry.shape[0]
    return np.unique(np.rint(np.linspace(0, bscans - 1, min(_CURVE_BSCANS, bscans))).astype(np.int64))


def _look(began: Start, stepper: Stepper | None, phantom: Phantom, seconds: float) -> CurvePoint:
    model = began.model
    field = NeuralField(model, began.shape, FieldDescription.of_volume(phantom.volume, "neural"))
    truth, noisy = field_psnr(field, (phantom.truth, phantom.volume), curve_bscans(phantom.volume))
    model.requires_grad_(True).train()  # a field freezes its model
    return CurvePoint(seconds, stepper.samples if stepper else 0, truth, noisy)


def _never() -> bool:
    return False
