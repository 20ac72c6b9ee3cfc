"""Fits of other neural fields to voxels, for so long or with so many samples."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from octn_ros.errors import TrainingError
from octn_ros.evaluation.rival_fields import Rival
from octn_ros.query.lattice import canonical_index
from octn_ros.training import ResidentVoxels
from octn_ros.volume import Volume, VolumeGeometry

_CHUNK_POINTS = 1 << 16


@dataclass(frozen=True, eq=False)
class RivalFit:
    """A fitted rival.

    Attributes:
        model: maps canonical points [N, 3] to intensities [N].
        steps: gradient steps.
        samples: voxels drawn.
        seconds: duration.
    """

    model: nn.Module
    steps: int
    samples: int
    seconds: float


def fit_rival(
    rival: Rival, volume: Volume, *, device: str, seed: int, seconds: float | None = None, samples: int | None = None
) -> RivalFit:
    """Fit a rival to a volume's voxels, drawn uniformly, by Adam and mean squared error.

    Args:
        rival: what is fitted, and its settings.
        volume: the C-scan.
        device: where.
        seed: of parameters and samples.
        seconds: how long; the learning rate then falls with the clock.
        samples: or with how many samples; one of the two must be given.

    Raises:
        TrainingError: neither or both are given.
    """
    if (seconds is None) == (samples is None):
        raise TrainingError(f"fit_rival: expected either seconds or samples, got {seconds} and {samples}")
    voxels = ResidentVoxels(volume, torch.device(device))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = rival.make().to(device)
    generator = torch.Generator(device).manual_seed(seed)
    adam = torch.optim.Adam(model.parameters(), lr=rival.learning_rate)
    began, steps, drawn, share = time.perf_counter(), 0, 0, 0.0
    while share < 1.0:
        adam.param_groups[0]["lr"] = rival.learning_rate * rival.final_rate_ratio**share
        flat = torch.randint(len(voxels), (rival.batch,), generator=generator, device=device)
        adam.zero_grad(set_to_none=True)
        loss: Tensor = (model(voxels.points(flat)) - voxels.at(flat)).square().mean()
        loss.backward()
        adam.step()
        steps, drawn = steps + 1, drawn + rival.batch
        if samples is not None:
            share = drawn / samples
        elif seconds is not None:
            if device.startswith("cuda"):
                torch.cuda.synchronize()
            share = (time.perf_counter() - began) / seconds
    return RivalFit(model.eval(), steps, drawn, time.perf_counter() - began)


def render_rival(
    model: nn.Module, geometry: VolumeGeometry, positions: NDArray[np.number], device: str
) -> NDArray[np.float32]:
    """Return a rival's intensities [position, axial, lateral] at whole or fractional B-scan positions of a grid."""
    bscans, axials, laterals = geometry.shape
    lateral, axial, bscan = (
        canonical_index(index, count, torch.device(device))
        for index, count in ((np.arange(laterals), laterals), (np.arange(axials), axials), (positions, bscans))
    )
    answer = np.empty((len(positions), axials, laterals), np.float32)
    plane = torch.stack(torch.meshgrid(lateral, axial, indexing="xy"), dim=-1).reshape(-1, 2)
    with torch.no_grad():
        for number, place in enumerate(bscan):
            points = torch.cat([plane, place.expand(len(plane), 1)], dim=1)
            values = torch.cat([model(chunk) for chunk in points.split(_CHUNK_POINTS)])
            answer[number] = values.reshape(axials, laterals).cpu().numpy()
    return answer
