"""What bricks of neighbouring samples and the start from the data do to a fit, at equal samples."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.evaluation.speed_config import SpeedBenchConfig
from octn_ros.evaluation.speed_curves import Yardstick, all_bscans, field_psnr, volume_psnr
from octn_ros.evaluation.speed_trainers import Start, make_stepper, start_model, train_to
from octn_ros.field import FieldDescription, NeuralField
from octn_ros.metrics import psnr_from_error_db
from octn_ros.simulation import Phantom, make_phantom
from octn_ros.training import FitConfig
from octn_ros.volume import Volume, gaussian_filter, subsample_bscans

# Samples of a fit are looked at this often, twice as many each time.
_LOOKS = 5
# What the paper calls SF: every second B-scan is held out.
_FACTOR = 2


def sample_rows(config: SpeedBenchConfig, against: Yardstick, device: str) -> list[dict[str, Any]]:
    """Return PSNR at equal samples for lone voxels and bricks, each from the mean and from the data.

    Both draw the same batch from the same volume with the same learning rate; lone voxels go through plain torch,
    bricks through the kernels, which also leave table rows alone that a step does not touch.
    """
    phantom = against.phantom
    rows = []
    for start in ("mean", "data"):
        settings = config.fit_config(start)
        for sampling, way in (("lone", "eager"), ("bricks", "fused")):
            began = start_model(phantom.volume, settings, device)
            stepper = make_stepper(way, began, phantom.volume, settings)
            for look in range(_LOOKS):
                wanted = config.samples >> (_LOOKS - 1 - look)
                train_to(wanted, stepper, settings, config.samples)
                truth_db, noisy_db = _psnr(began, phantom)
                rows.append(
                    {
                        "part": "samples",
                        "way": sampling,
                        "start": start,
                        "samples": stepper.samples,
                        "psnr_truth_db": truth_db,
                        "psnr_noisy_db": noisy_db,
                        "gaussian_truth_db": against.gaussian_db,
                    }
                )
    return rows


def between_rows(config: SpeedBenchConfig, against: Yardstick, device: str) -> list[dict[str, Any]]:
    """Return what a start costs between the voxels: PSNR against the truth on the grid, half a B-scan off it, and on
    held-out B-scans of a fit to every second one; for a Gaussian, interpolated linearly, beside.
    """
    phantom = against.phantom
    spacing = phantom.config.spacing_m[0]
    # The tissue half a B-scan nearer: its B-scan i is this one's i + 1/2.
    moved = make_phantom(dataclasses.replace(phantom.config, shift_m=(0.0, -0.5 * spacing, 0.0)))
    sparse = subsample_bscans(phantom.volume, _FACTOR)
    smooth, smooth_sparse = gaussian_filter(phantom.volume, 1.0), gaussian_filter(sparse.volume, 1.0)
    rows = [
        {
            "part": "between",
            "way": "gaussian",
            "start": "",
            "samples": 0,
            "psnr_truth_db": against.gaussian_db,
            "psnr_fraction_db": _halfway_psnr(smooth, moved.truth),
            "psnr_held_out_db": _held_out_psnr(smooth_sparse, phantom.truth),
            "psnr_noisy_db": volume_psnr(smooth, phantom.volume, all_bscans(smooth)),
        }
    ]
    for start in ("mean", "data"):
        settings = config.fit_config(start)
        whole = _fitted(phantom.volume, settings, config.samples, device)
        half = _fitted(sparse.volume, settings, config.samples, device)
        truth_db, noisy_db = _psnr(whole, phantom)
        rows.append(
            {
                "part": "between",
                "way": "fused",
                "start": start,
                "samples": config.samples,
                "psnr_truth_db": truth_db,
                "psnr_fraction_db": _off_grid_psnr(
                    whole, phantom.volume, moved.truth, _halves(phantom), range(len(_halves(phantom)))
                ),
                "psnr_held_out_db": _off_grid_psnr(
                    half, sparse.volume, phantom.truth, [b / _FACTOR for b in sparse.held_out], sparse.held_out
                ),
                "psnr_noisy_db": noisy_db,
            }
        )
    return rows


def _fitted(volume: Volume, settings: FitConfig, samples: int, device: str) -> Start:
    began = start_model(volume, settings, device)
    train_to(samples, make_stepper("fused", began, volume, settings), settings, samples)
    return began


def _field(began: Start, volume: Volume) -> NeuralField:
    return NeuralField(began.model, began.shape, FieldDescription.of_volume(volume, "neural"))


def _psnr(began: Start, phantom: Phantom) -> tuple[float, float]:
    truth, noisy = field_psnr(
        _field(began, phantom.volume), (phantom.truth, phantom.volume), all_bscans(phantom.volume)
    )
    began.model.requires_grad_(True).train()  # a field freezes its model
    return truth, noisy


def _halves(phantom: Phantom) -> list[float]:
    return [bscan + 0.5 for bscan in range(phantom.volume.geometry.shape[0] - 1)]


def _off_grid_psnr(
    began: Start, volume: Volume, truth: Volume, positions: Sequence[float], indices: Sequence[int]
) -> float:
    """Return the PSNR of a field at B-scan positions of its volume against B-scans of a truth of these numbers."""
    bscans, axials, laterals = volume.geometry.shape
    axial, lateral = (torch.linspace(-1.0, 1.0, n, device=began.voxels.device) for n in (axials, laterals))
    field, total, count = _field(began, volume), 0.0, 0
    for position, index in zip(positions, indices, strict=True):
        bscan = torch.tensor([2.0 * position / (bscans - 1) - 1.0], device=field.device)
        difference = field.lattice(lateral, axial, bscan)[0].cpu().numpy() - truth.normalized((index,))
        total, count = total + float(np.vdot(difference, difference)), count + difference.size
    return psnr_from_error_db(total / count)


def _halfway_psnr(volume: Volume, truth: Volume) -> float:
    between = 0.5 * (volume.normalized()[1:] + volume.normalized()[:-1])
    return _psnr_of(between - truth.normalized()[: len(between)])


def _held_out_psnr(volume: Volume, truth: Volume) -> float:
    kept = volume.normalized()
    between = 0.5 * (kept[1:] + kept[:-1])
    return _psnr_of(between - truth.normalized()[1::_FACTOR][: len(between)])


def _psnr_of(difference: NDArray[np.float32]) -> float:
    error = float(np.mean(np.square(difference, dtype=np.float64)))
    return psnr_from_error_db(error) if error > 0 else math.inf
