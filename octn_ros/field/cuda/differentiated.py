"""A neural model's answers from anything that maps points to intensities and can be differentiated once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Points at once where intermediates are kept: some 400 MB under the preset `paper`.
_CHUNK = 1 << 17


class DifferentiatedEvaluator:
    """Answers in chunks of points, gradients by automatic differentiation. Keeps no graph; thread-safe.

    Args:
        forward: maps canonical points [N, 3] to intensities [N], float32; differentiable once in the points.
    """

    def __init__(self, forward: Callable[[Tensor], Tensor]) -> None:
        self._forward = forward

    def evaluate(self, points: Tensor) -> Tensor:
        """Return intensities [N] at canonical points [N, 3]."""
        with torch.no_grad():
            return torch.cat([self._forward(chunk) for chunk in points.float().split(_CHUNK)])

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] at canonical points [N, 3]."""
        values, gradients = [], []
        with torch.enable_grad():
            for chunk in points.detach().float().split(_CHUNK):
                chunk = chunk.clone().requires_grad_(True)
                value = self._forward(chunk)
                (gradient,) = torch.autograd.grad(value.sum(), chunk)
                values.append(value.detach())
                gradients.append(gradient.masked_fill(chunk.isnan().any(dim=1, keepdim=True), torch.nan))
        return torch.cat(values), torch.cat(gradients)

    def axial_value_and_slope(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N]."""
        value, gradient = self.value_and_gradient(torch.stack((lateral, axial, bscan), dim=-1))
        return value, gradient[:, 1]

    def axial_lines(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        """Return intensities [N, K] at canonical depths [N, K] along the axial lines at lateral [N], bscan [N]."""
        points = torch.stack((lateral[:, None].expand_as(axial), axial, bscan[:, None].expand_as(axial)), dim=-1)
        return self.evaluate(points.view(-1, 3)).view(axial.shape)

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors."""
        answer = torch.empty(len(bscan), len(axial), len(lateral), device=lateral.device)
        rows = max(1, _CHUNK // max(1, len(lateral)))
        for plane, depth in zip(answer, bscan, strict=True):
            for strip, some in zip(plane.split(rows), axial.split(rows), strict=True):
                middle, fast = torch.meshgrid(some, lateral, indexing="ij")
                points = torch.stack((fast, middle, depth.expand_as(fast)), dim=-1)
                strip.copy_(self.evaluate(points.view(-1, 3)).view(strip.shape))
        return answer
