"""The field without learning: interpolation through the measured voxels, trilinear or by cubic B-splines."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from octn_ros.errors import ConfigurationError
from octn_ros.field.field import CHUNK_POINTS, DifferentiableField, FieldDescription
from octn_ros.field.spline import InterpolationOrder, Spline
from octn_ros.volume import Volume

# A cubic point reads 64 coefficients where a trilinear one reads 8.
_CHUNK = CHUNK_POINTS // 2


class InterpolatedField(DifferentiableField):
    """Interpolation through the voxels of a volume; read-only, thread-safe, exact at the voxels but for float32.

    Trilinear: continuous; the gradient is exact inside a voxel cell and that of the far cell at its faces; unmixed
    second derivatives vanish. Cubic: a B-spline, twice continuously differentiable inside the cube, so that curvature
    means something; it may overshoot the range of the voxels a little. Outside [-1, 1]^3 the value at the nearest
    point of the cube, and no derivative along the axes that were left.

    Args:
        volume: the measured C-scan; kept, since a checkpoint stores its voxels.
        device: where the voxels are kept and points are expected.
        order: "trilinear" or "cubic".

    Raises:
        ConfigurationError: the order is neither.
    """

    def __init__(
        self, volume: Volume, device: str | torch.device = "cpu", order: InterpolationOrder = "trilinear"
    ) -> None:
        if order not in ("trilinear", "cubic"):
            raise ConfigurationError(f"order: expected trilinear or cubic, got {order!r}")
        super().__init__(dataclasses.replace(FieldDescription.of_volume(volume, "interpolated"), order=order))
        self.volume = volume
        self._spline = Spline(volume.normalized(), order, device)

    @property
    def device(self) -> torch.device:
        """Where the voxels lie."""
        return self._spline.coefficients.device

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the intensities [N] at canonical points [N, 3]; differentiable in the points."""
        chunks = [points] if points.requires_grad else points.split(_CHUNK)
        return torch.cat([self._value(self.geometry.canonical_to_voxel(chunk.clamp(-1.0, 1.0))) for chunk in chunks])

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] by canonical position; the graph is not kept.

        Of a spline in closed form; a trilinear point is so cheap that automatic differentiation is quicker.
        """
        if self.description.order == "trilinear":
            return super().value_and_gradient(points)
        values, gradients = [], []
        for chunk in points.detach().split(_CHUNK // 4):
            by_index = self._by_index(chunk, highest=1)
            values.append(by_index[0, 0, 0])
            gradients.append(_gradient(by_index) * self._rate(chunk))
        return torch.cat(values), torch.cat(gradients)

    def value_gradient_hessian(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return intensities [N], gradients [N, 3] and Hessians [N, 3, 3] by canonical position, in closed form."""
        parts = [self._derivatives(chunk) for chunk in points.detach().split(_CHUNK // 8)]
        value, gradient, hessian = (torch.cat(part) for part in zip(*parts, strict=True))
        return value, gradient, hessian

    def axial_value_and_slope(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N].

        In closed form: the coefficients above and below are blended across, and differ by the slope.
        """
        values, slopes = [], []
        points = torch.stack((lateral, axial, bscan), dim=-1).detach()
        for chunk in points.split(_CHUNK):
            index = self.geometry.canonical_to_voxel(chunk.clamp(-1.0, 1.0))
            value, slope = self._axial(index)
            values.append(value)
            slopes.append(slope * (chunk[:, 1].abs() <= 1.0))
        return torch.cat(values), torch.cat(slopes) * (0.5 * (self.geometry.shape[1] - 1))

    def _value(self, index: Tensor) -> Tensor:
        if self.description.order == "cubic":
            return self._spline.value(index)
        return _trilinear(self._spline.coefficients, index)

    def _axial(self, index: Tensor) -> tuple[Tensor, Tensor]:
        if self.description.order == "cubic":
            return self._spline.axial_value_and_slope(*index.unbind(-1))
        near, far, fraction = _axial_faces(self._spline.coefficients, index)
        return near + (far - near) * fraction, far - near

    def _derivatives(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        by_index, rate = self._by_index(points, highest=2), self._rate(points)
        mixed = (by_index[0, 1, 1], by_index[1, 0, 1], by_index[1, 1, 0])
        unmixed = (by_index[0, 0, 2], by_index[0, 2, 0], by_index[2, 0, 0])
        rows = (
            (unmixed[0], mixed[0], mixed[1]),
            (mixed[0], unmixed[1], mixed[2]),
            (mixed[1], mixed[2], unmixed[2]),
        )
        hessian = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=1)
        return by_index[0, 0, 0], _gradient(by_index) * rate, hessian * rate[:, :, None] * rate[:, None, :]

    def _by_index(self, points: Tensor, highest: int) -> Tensor:
        return self._spline.derivatives(self.geometry.canonical_to_voxel(points.clamp(-1.0, 1.0)), highest)

    def _rate(self, points: Tensor) -> Tensor:
        """Return indices per canonical unit [N, (lateral, axial, bscan)], none along axes that a point has left."""
        bscans, axials, laterals = self.geometry.shape
        return points.new_tensor([laterals - 1, axials - 1, bscans - 1]) * 0.5 * (points.abs() <= 1.0)

    def _line_values(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        return self._spline.lines(self._index(bscan, 0), self._index(axial, 1), self._index(lateral, 2))

    def _lattice_values(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        return self._spline.lattice(self._index(bscan, 0), self._index(axial, 1), self._index(lateral, 2))

    def _index(self, canonical: Tensor, axis: int) -> Tensor:
        return (canonical.clamp(-1.0, 1.0) + 1.0) * (0.5 * (self.geometry.shape[axis] - 1))


def _gradient(by_index: Tensor) -> Tensor:
    return torch.stack((by_index[0, 0, 1], by_index[0, 1, 0], by_index[1, 0, 0]), dim=-1)


def _trilinear(voxels: Tensor, index: Tensor) -> Tensor:
    """Interpolate voxels [bscan, axial, lateral] trilinearly at fractional indices [N, 3] inside the array.

    Differentiable in both; any device.
    """
    near, far, fraction = _axial_faces(voxels, index)
    return near + (far - near) * fraction


def _axial_faces(voxels: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the bilinear values [N] in the near and far axial face of each point's cell, and its axial fraction."""
    cells, fractions = [], []
    for axis, length in enumerate(voxels.shape):
        cell = index[:, axis].detach().floor().long().clamp(0, length - 2)
        cells.append(cell)
        fractions.append(index[:, axis] - cell)
    strides = voxels.stride()
    first = cells[0] * strides[0] + cells[1] * strides[1] + cells[2] * strides[2]
    flat = voxels.view(-1)

    def face(start: Tensor) -> Tensor:
        rows = []
        for corner in (start, start + strides[0]):
            left, right = flat[corner], flat[corner + strides[2]]
            rows.append(left + (right - left) * fractions[2])
        return rows[0] + (rows[1] - rows[0]) * fractions[0]

    return face(first), face(first + strides[1]), fractions[1]
