"""What a fitted field loses when its parameters travel as float16."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from octn_ros.field import NeuralField, dumps_field, loads_field
from octn_ros.training.held_in import EVALUATED_VOXELS, evaluated_bscans


@dataclass(frozen=True)
class HalfPrecisionLoss:
    """Difference between a field and what its float16 message gives back, in units of the intensity range [0, 1].

    Attributes:
        rms: root mean square.
        largest: largest absolute difference.
    """

    rms: float
    largest: float


def half_precision_loss(field: NeuralField) -> HalfPrecisionLoss:
    """Measure the loss on a fixed random subset of the voxels of the evenly spaced B-scans that fits are judged on.

    Some 16,000 voxels, a few milliseconds beside what it takes to store and load the field once. Thread-safe; any
    device.

    Args:
        field: the fitted field, parameters as float32.

    Raises:
        CheckpointError: a parameter is too large for float16.
    """
    rounded = loads_field(dumps_field(field, half=True), field.device)
    points = _points(field)
    difference = rounded.evaluate(points) - field.evaluate(points)
    return HalfPrecisionLoss(float(difference.square().mean().sqrt()), float(difference.abs().max()))


def _points(field: NeuralField) -> Tensor:
    _, axials, laterals = field.geometry.shape
    bscans = torch.from_numpy(evaluated_bscans(field.geometry))
    generator = torch.Generator().manual_seed(0)
    columns = [
        bscans[torch.randint(len(bscans), (EVALUATED_VOXELS,), generator=generator)],
        torch.randint(axials, (EVALUATED_VOXELS,), generator=generator),
        torch.randint(laterals, (EVALUATED_VOXELS,), generator=generator),
    ]
    index = torch.stack(columns, dim=-1).float().to(field.device)
    return field.geometry.voxel_to_canonical(index)
