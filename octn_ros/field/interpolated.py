"""The field without learning: trilinear interpolation through the measured voxels."""

from __future__ import annotations

import torch
from torch import Tensor

from octn_ros.field.field import DifferentiableField, FieldDescription
from octn_ros.volume import Volume, VolumeGeometry


class InterpolatedField(DifferentiableField):
    """Trilinear interpolation of a volume; read-only, thread-safe, exact at the voxels.

    Differentiable in the points; the gradient is exact inside a voxel cell, that of the far cell at its faces, and
    zero outside the cube.

    Args:
        volume: the measured C-scan.
        device: where its voxels are kept and points are expected.
    """

    def __init__(self, volume: Volume, device: str | torch.device = "cpu") -> None:
        self._voxels = torch.from_numpy(volume.normalized()).to(device)
        self._description = FieldDescription.of_volume(volume, "interpolated")

    @property
    def kind(self) -> str:
        """Always "interpolated"."""
        return self._description.kind

    @property
    def geometry(self) -> VolumeGeometry:
        """Shape and place of the scan."""
        return self._description.geometry

    @property
    def description(self) -> FieldDescription:
        """Origin of the field."""
        return self._description

    @property
    def device(self) -> torch.device:
        """Where the voxels lie."""
        return self._voxels.device

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the intensities [N] at canonical points [N, 3]; differentiable in the points."""
        return interpolate_voxels(self._voxels, self.geometry.canonical_to_voxel(points.clamp(-1.0, 1.0)))


def interpolate_voxels(voxels: Tensor, index: Tensor) -> Tensor:
    """Interpolate voxels [bscan, axial, lateral] trilinearly at fractional indices [N, 3] inside the array.

    Differentiable in both; any device.
    """
    last = torch.tensor(voxels.shape, device=voxels.device) - 2
    cell = torch.minimum(index.detach().floor().long().clamp(min=0), last)
    fraction = index - cell
    strides = voxels.stride()
    first = cell[:, 0] * strides[0] + cell[:, 1] * strides[1] + cell[:, 2] * strides[2]
    flat = voxels.view(-1)
    total = torch.zeros_like(fraction[:, 0])
    for d in (0, 1):
        for h in (0, 1):
            for w in (0, 1):
                share = _share(fraction[:, 0], d) * _share(fraction[:, 1], h) * _share(fraction[:, 2], w)
                total = total + share * flat[first + (d * strides[0] + h * strides[1] + w * strides[2])]
    return total


def _share(fraction: Tensor, side: int) -> Tensor:
    return fraction if side else 1.0 - fraction
