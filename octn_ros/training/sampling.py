"""Training samples drawn on the device from the resident volume."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from octn_ros.volume import Volume


class ResidentVoxels:
    """A volume's voxels on a device in their own type, normalised when they are looked up: no copy is made of all.

    Read-only, thread-safe. On the CPU it shares the volume's memory where it can.

    Args:
        volume: the C-scan.
        device: where its voxels are kept.
    """

    def __init__(self, volume: Volume, device: torch.device) -> None:
        self.geometry = volume.geometry
        array = np.ascontiguousarray(volume.array)
        if not array.flags.writeable:  # torch warns of memory that must not be written to, such as a mapped file
            array = array.copy()
        # torch can hardly compute with uint16; the bits of an int16 are told apart again when they are looked up.
        self._unsigned16 = array.dtype == np.uint16
        self._flat = torch.from_numpy(array.view(np.int16) if self._unsigned16 else array).to(device).view(-1)
        self._last_cell = torch.tensor(self.geometry.shape, dtype=torch.float32, device=device) - 2
        low, high = volume.intensity_range
        self._low, self._scale = float(np.float32(low)), float(np.float32(1.0 / (high - low)))

    def __len__(self) -> int:
        """Return the number of voxels."""
        return self._flat.numel()

    @property
    def device(self) -> torch.device:
        """Where the voxels lie."""
        return self._flat.device

    def at(self, flat: Tensor) -> Tensor:
        """Return the intensities in [0, 1], as `Volume.normalized` has them, at flat voxel numbers of any shape."""
        raw = self._flat[flat]
        raw = (raw.int() & 0xFFFF).float() if self._unsigned16 else raw.float()
        return raw.sub_(self._low).mul_(self._scale).clamp_(0.0, 1.0)

    def points(self, flat: Tensor) -> Tensor:
        """Return the canonical points [N, 3] of flat voxel numbers [N] (eq. 2)."""
        _, axials, laterals = self.geometry.shape
        column = torch.div(flat, laterals, rounding_mode="floor")
        bscan = torch.div(column, axials, rounding_mode="floor")
        index = torch.stack((bscan, column - bscan * axials, flat - column * laterals), dim=-1)
        return self.geometry.voxel_to_canonical(index.float())

    def interpolate(self, points: Tensor) -> Tensor:
        """Return the trilinearly interpolated intensities [N] at canonical points [N, 3] of the cube."""
        index = self.geometry.canonical_to_voxel(points)
        cell = torch.minimum(index.floor().clamp_(min=0), self._last_cell)
        far = index - cell
        near = 1.0 - far
        _, axials, laterals = self.geometry.shape
        low = cell.long()
        first = (low[:, 0] * axials + low[:, 1]) * laterals + low[:, 2]
        total = torch.zeros_like(far[:, 0])
        for bscan, share_b in enumerate((near[:, 0], far[:, 0])):
            for axial, share_a in enumerate((near[:, 1], far[:, 1])):
                plane = share_b * share_a
                for lateral, share_l in enumerate((near[:, 2], far[:, 2])):
                    total += plane * share_l * self.at(first + ((bscan * axials + axial) * laterals + lateral))
        return total


class VoxelSampler:
    """Draws native voxels and interpolated points with their intensities, uniformly and independently.

    Not thread-safe: it owns a random generator. Works on the device it is made for.

    Args:
        voxels: the C-scan.
        seed: start of the random sequence.
    """

    def __init__(self, voxels: ResidentVoxels, seed: int) -> None:
        self._voxels = voxels
        self._generator = torch.Generator(device=voxels.device).manual_seed(seed)

    def discrete(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw `count` voxels of the native grid: canonical points [count, 3] and measured intensities [count]."""
        flat = torch.randint(len(self._voxels), (count,), generator=self._generator, device=self._voxels.device)
        return self._voxels.points(flat), self._voxels.at(flat)

    def interpolated(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw `count` points uniformly in [-1, 1]^3 with trilinearly interpolated intensities."""
        unit = torch.rand(count, 3, generator=self._generator, device=self._voxels.device)
        points = unit.mul_(2.0).sub_(1.0)
        return points, self._voxels.interpolate(points)

    def batch(self, count: int, interpolated_share: float) -> tuple[Tensor, Tensor]:
        """Draw one batch as Algorithm 1 does: floor(alpha B) interpolated samples, the rest voxels.

        Returns:
            points [count, 3] and intensities [count], voxels first.
        """
        interpolated = interpolated_count(count, interpolated_share)
        points, intensities = self.discrete(count - interpolated)
        if interpolated:
            more_points, more_intensities = self.interpolated(interpolated)
            points, intensities = torch.cat((points, more_points)), torch.cat((intensities, more_intensities))
        return points, intensities


def interpolated_count(count: int, share: float) -> int:
    """Return floor(alpha B), Algorithm 1's C_interp; the product is rounded first, since 0.29 * 100 is below 29."""
    return math.floor(round(share * count, 6))
