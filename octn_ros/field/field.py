"""What every field answers, whatever it is made of."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from octn_ros import __version__
from octn_ros.volume import IntensityScale, Volume, VolumeGeometry

# Points evaluated at once: large enough to keep two cores busy, small enough for intermediates of some 100 MB.
CHUNK_POINTS = 1 << 16


@dataclass(frozen=True)
class FieldDescription:
    """Where a field comes from; travels with it in every file and message.

    Attributes:
        kind: "neural" or "interpolated".
        geometry: shape and place of the scan the field stands for.
        intensity_range: raw values that became 0 and 1.
        intensity_scale: whether raw values are linear in reflected power or logarithmic.
        stamp_ns: acquisition time of the scan in nanoseconds, 0 if unknown.
        training: configuration and figures of the fit, as JSON can hold them; empty for an interpolated field.
        software_version: version of this package that made the field.
        order: "trilinear" or "cubic" for an interpolated field, empty for a neural one.
    """

    kind: str
    geometry: VolumeGeometry
    intensity_range: tuple[float, float]
    intensity_scale: IntensityScale
    stamp_ns: int = 0
    training: dict[str, Any] = field(default_factory=dict)
    software_version: str = __version__
    order: str = ""

    @classmethod
    def of_volume(cls, volume: Volume, kind: str, training: dict[str, Any] | None = None) -> FieldDescription:
        """Describe a field of `kind` made from a volume."""
        return cls(
            kind, volume.geometry, volume.intensity_range, volume.intensity_scale, volume.stamp_ns, training or {}
        )


class Field(Protocol):
    """An intensity at every point of a scanned cube (eq. 1), in canonical coordinates (lateral, axial, bscan).

    Implementations are safe to read from several threads and take the value at the nearest point of the cube for
    points outside [-1, 1]^3; derivatives along an axis that was left are zero there. At the faces of cells, where a
    piecewise field has no derivative, that of the cell on the far side (larger coordinate) is returned.
    """

    @property
    def kind(self) -> str:
        """What the field is made of: "neural" or "interpolated"."""
        ...

    @property
    def geometry(self) -> VolumeGeometry:
        """Shape and place of the scan."""
        ...

    @property
    def device(self) -> torch.device:
        """Where points are expected and answers lie."""
        ...

    @property
    def description(self) -> FieldDescription:
        """Origin of the field."""
        ...

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the intensities [N] at canonical points [N, 3]; differentiable in the points."""
        ...

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] by canonical position; the graph is not kept."""
        ...

    def value_gradient_hessian(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return intensities [N], gradients [N, 3] and Hessians [N, 3, 3] by canonical position, all exact."""
        ...

    def axial_value_and_slope(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N]."""
        ...

    def axial_lines(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        """Return intensities [N, K] at canonical depths [N, K] along the axial lines at lateral [N], bscan [N]."""
        ...

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors."""
        ...


class DifferentiableField:
    """Everything a field answers in terms of `evaluate`, by automatic differentiation: the reference for fast paths.

    Args:
        description: where the field comes from.
    """

    # Points evaluated at once without a graph; automatic differentiation keeps several times as much of each.
    _chunk = CHUNK_POINTS

    def __init__(self, description: FieldDescription) -> None:
        self.description = description
        self.kind = description.kind
        self.geometry = description.geometry

    @property
    def device(self) -> torch.device:
        """Where points are expected and answers lie."""
        raise NotImplementedError

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the intensities [N] at canonical points [N, 3]; differentiable in the points."""
        raise NotImplementedError

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] by canonical position.

        By automatic differentiation, in chunks; at cell faces, where a piecewise field has no derivative, that of the
        cell on the far side. The graph is not kept, so use `evaluate` to differentiate further.
        """
        values, gradients = [points.new_zeros(0)], [points.new_zeros(0, 3)]
        with torch.enable_grad():
            for chunk in points.detach().split(max(1, self._chunk // 4)):
                chunk = chunk.clone().requires_grad_(True)
                value = self.evaluate(chunk)
                (gradient,) = torch.autograd.grad(value.sum(), chunk)
                values.append(value.detach())
                gradients.append(gradient)
        return torch.cat(values), torch.cat(gradients)

    def value_gradient_hessian(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return intensities [N], gradients [N, 3] and Hessians [N, 3, 3] by canonical position.

        By automatic differentiation, in chunks: exact inside cells, with the far cell's derivatives at their faces.
        A trilinear field has no curvature of its own: its unmixed second derivatives vanish almost everywhere.
        """
        values = [points.new_zeros(0)]
        gradients, hessians = [points.new_zeros(0, 3)], [points.new_zeros(0, 3, 3)]
        with torch.enable_grad():
            for chunk in points.detach().split(max(1, self._chunk // 8)):
                chunk = chunk.clone().requires_grad_(True)
                value = self.evaluate(chunk)
                (gradient,) = torch.autograd.grad(value.sum(), chunk, create_graph=True)
                rows = [_row_of_hessian(gradient[:, axis], chunk) for axis in range(3)]
                values.append(value.detach())
                gradients.append(gradient.detach())
                hessians.append(torch.stack(rows, dim=1))
        return torch.cat(values), torch.cat(gradients), torch.cat(hessians)

    def axial_value_and_slope(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N].

        The inner step of Newton's method (eq. 10); the graph is not kept.
        """
        value, gradient = self.value_and_gradient(torch.stack((lateral, axial, bscan), dim=-1))
        return value, gradient[:, 1]

    def axial_lines(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        """Return intensities [N, K] at canonical depths [N, K] along the axial lines at lateral [N], bscan [N].

        Evaluated in chunks of lines without gradients; equal to `evaluate` at the same points.
        """
        if axial.numel() == 0:
            return torch.zeros_like(axial)
        lines = max(1, CHUNK_POINTS // axial.shape[1])
        chunks = zip(lateral.split(lines), bscan.split(lines), axial.split(lines), strict=True)
        with torch.no_grad():
            return torch.cat([self._line_values(x, z, depth) for x, z, depth in chunks])

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors.

        Evaluated in slabs without gradients, so memory does not grow with the lattice beyond the answer itself; equal
        to `evaluate` at the same points.
        """
        answer = torch.empty(len(bscan), len(axial), len(lateral), dtype=lateral.dtype, device=self.device)
        columns = max(1, min(len(lateral), CHUNK_POINTS))
        rows = max(1, min(len(axial), CHUNK_POINTS // columns))
        slices = max(1, CHUNK_POINTS // (columns * rows))
        with torch.no_grad():
            for slab in _slabs(answer.shape, (slices, rows, columns)):
                answer[slab] = self._lattice_values(lateral[slab[2]], axial[slab[1]], bscan[slab[0]])
        return answer

    def _line_values(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        points = torch.stack((lateral[:, None].expand_as(axial), axial, bscan[:, None].expand_as(axial)), dim=-1)
        return self.evaluate(points.view(-1, 3)).view(axial.shape)

    def _lattice_values(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        slow, middle, fast = torch.meshgrid(bscan, axial, lateral, indexing="ij")
        return self.evaluate(torch.stack((fast, middle, slow), dim=-1).view(-1, 3)).view(slow.shape)


def _slabs(shape: tuple[int, ...], size: tuple[int, int, int]) -> Iterator[tuple[slice, ...]]:
    starts = (range(0, length, step) for length, step in zip(shape, size, strict=True))
    for corner in itertools.product(*starts):
        yield tuple(slice(start, start + step) for start, step in zip(corner, size, strict=True))


def _row_of_hessian(component: Tensor, points: Tensor) -> Tensor:
    # Where the gradient does not depend on the position at all, there is no graph to differentiate.
    if not component.requires_grad:
        return torch.zeros_like(points)
    (row,) = torch.autograd.grad(component.sum(), points, retain_graph=True, materialize_grads=True)
    return row.detach()
