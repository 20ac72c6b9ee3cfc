"""Training samples drawn on the device from the resident volume."""

from __future__ import annotations

import torch
from torch import Tensor

from octn_ros.field.interpolated import interpolate_voxels
from octn_ros.volume import Volume


class VoxelSampler:
    """Draws native voxels and interpolated points with their intensities, uniformly and independently.

    Not thread-safe: it owns a random generator. Works on the device it is made for.

    Args:
        volume: the C-scan; kept on the device as float32.
        device: where samples are drawn.
        seed: start of the random sequence.
    """

    def __init__(self, volume: Volume, device: torch.device, seed: int) -> None:
        self._geometry = volume.geometry
        self._voxels = torch.from_numpy(volume.normalized()).to(device)
        self._generator = torch.Generator(device=device).manual_seed(seed)

    def discrete(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw `count` voxels of the native grid: canonical points [count, 3] and measured intensities [count]."""
        flat = torch.randint(self._voxels.numel(), (count,), generator=self._generator, device=self._voxels.device)
        _, axials, laterals = self._voxels.shape
        column = torch.div(flat, laterals, rounding_mode="floor")
        index = torch.stack(
            (torch.div(column, axials, rounding_mode="floor"), column % axials, flat % laterals), dim=-1
        )
        return self._geometry.voxel_to_canonical(index.float()), self._voxels.view(-1)[flat]

    def interpolated(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw `count` points uniformly in [-1, 1]^3 with trilinearly interpolated intensities."""
        unit = torch.rand(count, 3, generator=self._generator, device=self._voxels.device)
        points = unit * 2.0 - 1.0
        return points, interpolate_voxels(self._voxels, self._geometry.canonical_to_voxel(points))

    def batch(self, count: int, interpolated_share: float) -> tuple[Tensor, Tensor, int]:
        """Draw one batch as Algorithm 1 does: floor(alpha B) interpolated samples, the rest voxels.

        Returns:
            points [count, 3], intensities [count], and how many of them, the first ones, are voxels.
        """
        interpolated = int(interpolated_share * count)
        points, intensities = self.discrete(count - interpolated)
        if interpolated:
            more_points, more_intensities = self.interpolated(interpolated)
            points, intensities = torch.cat((points, more_points)), torch.cat((intensities, more_intensities))
        return points, intensities, count - interpolated
