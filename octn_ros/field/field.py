"""What every field answers, whatever it is made of."""

from __future__ import annotations

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
    """

    kind: str
    geometry: VolumeGeometry
    intensity_range: tuple[float, float]
    intensity_scale: IntensityScale
    stamp_ns: int = 0
    training: dict[str, Any] = field(default_factory=dict)
    software_version: str = __version__

    @classmethod
    def of_volume(cls, volume: Volume, kind: str, training: dict[str, Any] | None = None) -> FieldDescription:
        """Describe a field of `kind` made from a volume."""
        return cls(
            kind, volume.geometry, volume.intensity_range, volume.intensity_scale, volume.stamp_ns, training or {}
        )


class Field(Protocol):
    """An intensity at every point of a scanned cube (eq. 1), in canonical coordinates (lateral, axial, bscan).

    Implementations are safe to read from several threads and take the value at the nearest point of the cube for
    points outside [-1, 1]^3.
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

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors."""
        ...


class DifferentiableField:
    """Gradient and lattice in terms of `evaluate`, for any field."""

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
        values, gradients = [], []
        with torch.enable_grad():
            for chunk in points.detach().split(CHUNK_POINTS):
                chunk = chunk.clone().requires_grad_(True)
                value = self.evaluate(chunk)
                (gradient,) = torch.autograd.grad(value.sum(), chunk)
                values.append(value.detach())
                gradients.append(gradient)
        if not values:
            return points.new_zeros(0), points.new_zeros(0, 3)
        return torch.cat(values), torch.cat(gradients)

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors.

        Evaluated in chunks without gradients, so memory does not grow with the lattice beyond the answer itself.
        """
        answer = torch.empty(len(bscan), len(axial), len(lateral), device=self.device)
        flat = answer.view(-1)
        start = 0
        with torch.no_grad():
            for points in _lattice_chunks(lateral, axial, bscan):
                flat[start : start + len(points)] = self.evaluate(points)
                start += len(points)
        return answer


def _lattice_chunks(lateral: Tensor, axial: Tensor, bscan: Tensor) -> Iterator[Tensor]:
    total, plane = len(bscan) * len(axial) * len(lateral), len(axial) * len(lateral)
    for start in range(0, total, CHUNK_POINTS):
        index = torch.arange(start, min(start + CHUNK_POINTS, total), device=lateral.device)
        within = index % plane
        yield torch.stack(
            (
                lateral[within % len(lateral)],
                axial[torch.div(within, len(lateral), rounding_mode="floor")],
                bscan[torch.div(index, plane, rounding_mode="floor")],
            ),
            dim=-1,
        )
