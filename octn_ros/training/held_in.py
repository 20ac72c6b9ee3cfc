"""How well a field gives back the voxels it was fitted to: cheaply during a fit, on whole B-scans after it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from octn_ros.field import Field
from octn_ros.metrics import psnr_from_error_db
from octn_ros.training.sampling import ResidentVoxels
from octn_ros.volume import Volume, VolumeGeometry

# The paper evaluates its training curve on 16 evenly spaced B-scans (fig. 7a).
EVALUATED_BSCANS = 16
# Voxels of them that a running fit is held against: their mean squared error has a standard error of about 1 %.
EVALUATED_VOXELS = 1 << 14
# Voxels of a strip, between two of which an evaluation can be cancelled: a few hundredths of a second under `fast`.
STRIP_VOXELS = 1 << 14


def evaluated_bscans(geometry: VolumeGeometry, count: int = EVALUATED_BSCANS) -> NDArray[np.int64]:
    """Return the numbers of `count` evenly spaced B-scans, all of them if there are fewer."""
    bscans = geometry.shape[0]
    return np.rint(np.linspace(0, bscans - 1, min(count, bscans))).astype(np.int64)


class HeldInVoxels:
    """A fixed random subset of the voxels of the evaluated B-scans; the same for every fit of one geometry.

    Args:
        voxels: the C-scan.
    """

    def __init__(self, voxels: ResidentVoxels) -> None:
        _, axials, laterals = voxels.geometry.shape
        bscans = torch.from_numpy(evaluated_bscans(voxels.geometry))
        generator = torch.Generator().manual_seed(0)
        chosen = torch.randint(len(bscans) * axials * laterals, (EVALUATED_VOXELS,), generator=generator)
        plane = axials * laterals
        flat = bscans[torch.div(chosen, plane, rounding_mode="floor")] * plane + chosen % plane
        flat = flat.to(voxels.device)
        self._points, self._intensities = voxels.points(flat), voxels.at(flat)
        self.mean = float(self._intensities.mean())
        self.variance = float(self._intensities.var())

    def mean_squared_error(self, evaluate: Callable[[Tensor], Tensor]) -> float:
        """Return the mean squared error on these voxels of what answers for canonical points; NaN if it does so."""
        return float((evaluate(self._points) - self._intensities).square().mean())

    @staticmethod
    def period(batch: int) -> int:
        """Return after how many steps to evaluate again, so that it costs less than 2 % of the fit.

        A step costs at least three times as much for each sample as an evaluation, which has no backward pass.
        """
        return max(10, math.ceil(20 * EVALUATED_VOXELS / batch))


def psnr_of_field(
    field: Field,
    volume: Volume,
    bscans: int = EVALUATED_BSCANS,
    cancelled: Callable[[], bool] | None = None,
) -> float:
    """Return the PSNR in dB of a field against a volume's voxels, on evenly spaced B-scans.

    Works in strips of some 16,000 voxels, so that neither a large volume is copied nor whoever cancels waits.

    Args:
        field: any field of the volume's geometry.
        volume: what was measured.
        bscans: how many B-scans are compared, all if there are fewer.
        cancelled: asked before every strip; True ends the comparison.

    Returns:
        10 log10(1 / mean squared error), infinity for a perfect field, NaN if cancelled.
    """
    _, axials, laterals = volume.geometry.shape
    bscan, axial, lateral = (torch.linspace(-1.0, 1.0, n, device=field.device) for n in volume.geometry.shape)
    rows = max(1, STRIP_VOXELS // laterals)
    total, count = 0.0, 0
    for index in evaluated_bscans(volume.geometry, bscans).tolist():
        for row in range(0, axials, rows):
            if cancelled is not None and cancelled():
                return math.nan
            strip = slice(row, row + rows)
            rendered = field.lattice(lateral, axial[strip], bscan[index : index + 1])[0].cpu().numpy()
            difference = rendered.astype(np.float64) - volume.normalized((index, strip))
            total += float(np.vdot(difference, difference))
            count += difference.size
    return psnr_from_error_db(total / count)
