"""A field in metres of the OCT frame, for those who measure rather than index."""

from __future__ import annotations

import torch
from torch import Tensor

from octn_ros.field.field import Field
from octn_ros.volume import VolumeGeometry

# Canonical axis (lateral, axial, bscan) that each metric axis (x, y, z) = (lateral, bscan, axial) runs along.
_CANONICAL_AXIS = [0, 2, 1]


class MetricField:
    """A view of a field in metric coordinates (x, y, z) = (lateral, bscan, axial); as thread-safe as the field.

    The swap of two axes mirrors space: gradients and Hessians are those of the OCT frame, so normals taken from them
    are right-handed there. Outside the scanned box the nearest point of the box answers, as in the field itself.

    Args:
        field: the field that answers.
    """

    def __init__(self, field: Field) -> None:
        self.field = field
        m = field.geometry.metres_per_canonical
        self._rate = [1.0 / m[axis] for axis in _CANONICAL_AXIS]

    @property
    def geometry(self) -> VolumeGeometry:
        """Shape and place of the scan."""
        return self.field.geometry

    @property
    def device(self) -> torch.device:
        """Where points are expected and answers lie."""
        return self.field.device

    def evaluate(self, points_m: Tensor) -> Tensor:
        """Return the intensities [N] at metric points [N, 3]; differentiable in the points."""
        return self.field.evaluate(self.geometry.metric_to_canonical(points_m))

    def value_and_gradient(self, points_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] per metre at metric points [N, 3]."""
        value, gradient = self.field.value_and_gradient(self.geometry.metric_to_canonical(points_m))
        return value, gradient[:, _CANONICAL_AXIS] * gradient.new_tensor(self._rate)

    def value_gradient_hessian(self, points_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return intensities [N], gradients [N, 3] per metre and Hessians [N, 3, 3] per square metre."""
        value, gradient, hessian = self.field.value_gradient_hessian(self.geometry.metric_to_canonical(points_m))
        rate = gradient.new_tensor(self._rate)
        hessian = hessian[:, _CANONICAL_AXIS][:, :, _CANONICAL_AXIS]
        return value, gradient[:, _CANONICAL_AXIS] * rate, hessian * rate[:, None] * rate

    def lattice(self, x_m: Tensor, y_m: Tensor, z_m: Tensor) -> Tensor:
        """Return intensities [y, z, x], the array order [bscan, axial, lateral], on the lattice of metric vectors."""
        origin = self.geometry.origin_m
        canonical = [
            (axis_m - start) * rate - 1.0
            for axis_m, start, rate in zip((x_m, y_m, z_m), origin, self._rate, strict=True)
        ]
        return self.field.lattice(canonical[0], canonical[2], canonical[1])
