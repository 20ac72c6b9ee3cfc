"""Roots of f - tau along axial lines: bracket, safeguarded Newton, bisection (eqs. 8 to 11)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from octn_ros.field import Field

_CHUNK_POINTS = 1 << 16
# Halving an interval of a voxel this often ends below the resolution of float32.
_BISECTIONS = 20


@dataclass(frozen=True)
class AxialLines:
    """Lines along the beam through a field, one for each raster point; depths along them are in axial voxels.

    Attributes:
        field: the field they run through.
        lateral: canonical lateral coordinate of each line [N], on the field's device.
        bscan: canonical B-scan coordinate of each line [N].
    """

    field: Field
    lateral: Tensor
    bscan: Tensor

    @property
    def last(self) -> float:
        """Depth of the deepest voxel."""
        return float(self.field.geometry.shape[1] - 1)

    def value(self, depth: Tensor, lines: Tensor) -> Tensor:
        """Return the field's intensity [M] at depths [M] of the lines with index [M]."""
        with torch.no_grad():
            parts = [self.field.evaluate(part) for part in self._points(depth, lines).split(_CHUNK_POINTS)]
        return torch.cat(parts)

    def value_and_slope(self, depth: Tensor, lines: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensity [M] and its exact derivative by depth [M], per axial voxel."""
        value, gradient = self.field.value_and_gradient(self._points(depth, lines))
        return value, gradient[:, 1] * (2.0 / self.last)

    def _points(self, depth: Tensor, lines: Tensor) -> Tensor:
        return torch.stack((self.lateral[lines], depth * (2.0 / self.last) - 1.0, self.bscan[lines]), dim=-1)


@dataclass(frozen=True)
class Brackets:
    """Where each line may have its root, in axial voxels, all [N].

    Attributes:
        low: shallow end; where `found`, the intensity there is below tau.
        high: deep end; where `found`, the intensity there is at least tau.
        start: first guess between them.
        found: whether the intensity rises through tau between the ends.
    """

    low: Tensor
    high: Tensor
    start: Tensor
    found: Tensor


@dataclass(frozen=True)
class Roots:
    """What the refinement ended with on each line, all [N].

    Attributes:
        depth: in axial voxels.
        residual: f - tau there.
        slope: derivative of the intensity at the last Newton evaluation, per axial voxel.
    """

    depth: Tensor
    residual: Tensor
    slope: Tensor


def bracket_rises(lines: AxialLines, tau: float, coarse: Tensor, radius: float, candidates: int) -> Brackets:
    """Sample candidate depths around the coarse surface and bracket the rise through tau nearest to it.

    Where no neighbouring candidates lie on either side of tau, the bracket is the whole neighbourhood and the start
    the middle of the steepest rise (eq. 8).

    Args:
        lines: the lines that are searched.
        tau: intensity of the surface.
        coarse: coarse depth of each line [N], in axial voxels.
        radius: half width of the neighbourhood in axial voxels.
        candidates: N_warmup, number of depths that are sampled, at least 2.
    """
    every = torch.arange(len(coarse), device=coarse.device)
    offsets = torch.linspace(-radius, radius, candidates, device=coarse.device)
    depth = (coarse[:, None] + offsets).clamp(0.0, lines.last)
    excess = torch.stack([lines.value(depth[:, k], every) - tau for k in range(candidates)], dim=1)
    below, above = excess[:, :-1], excess[:, 1:]
    rises = (below < 0) & (above >= 0)
    crossing = depth[:, :-1] + (depth[:, 1:] - depth[:, :-1]) * (below / (below - above)).nan_to_num(0.5)
    distance = torch.where(rises, (crossing - coarse[:, None]).abs(), torch.inf)
    found = rises.any(dim=1)
    chosen = torch.where(found, distance.argmin(dim=1), (above - below).nan_to_num(0.0).argmax(dim=1))[:, None]
    low, high = depth[:, :-1].gather(1, chosen)[:, 0], depth[:, 1:].gather(1, chosen)[:, 0]
    start = torch.where(found, crossing.gather(1, chosen)[:, 0], 0.5 * (low + high))
    return Brackets(torch.where(found, low, depth[:, 0]), torch.where(found, high, depth[:, -1]), start, found)


def refine_roots(
    lines: AxialLines,
    tau: float,
    brackets: Brackets,
    *,
    steps: int,
    min_slope: float,
    max_step: float,
    tolerance: float,
) -> Roots:
    """Refine by Newton's method (eq. 10) with exact gradients, inside each line's bracket.

    Safeguards of the paper: no step where the slope is below `min_slope`, no step longer than `max_step`, none out of
    the neighbourhood. Where a sign change is bracketed, the middle of the bracket takes the place of a refused step,
    and what Newton leaves open is bisected, so that a root that is there is found.

    Args:
        lines: the lines that are refined.
        tau: intensity of the surface.
        brackets: where to look.
        steps: largest number of Newton steps.
        min_slope: smallest usable derivative of the intensity per axial voxel.
        max_step: longest step in axial voxels.
        tolerance: residual at which a line is done.
    """
    low, high, depth = brackets.low.clone(), brackets.high.clone(), brackets.start.clone()
    best_depth, best_residual = depth.clone(), torch.full_like(depth, torch.inf)
    slopes = torch.zeros_like(depth)
    active = torch.arange(len(depth), device=depth.device)
    for step in range(steps + _BISECTIONS):
        if len(active) == 0:
            break
        here, found = depth[active], brackets.found[active]
        newton = step < steps
        if newton:
            value, slope = lines.value_and_slope(here, active)
            slopes[active] = slope
        else:
            value, slope = lines.value(here, active), torch.zeros_like(here)
        residual = value - tau
        better = residual.abs() < best_residual[active].abs()
        best_residual[active] = torch.where(better, residual, best_residual[active])
        best_depth[active] = torch.where(better, here, best_depth[active])
        low[active] = torch.where(found & (residual < 0), here, low[active])
        high[active] = torch.where(found & (residual >= 0), here, high[active])
        usable = slope >= min_slope
        proposal = here - torch.where(usable, residual / slope, torch.zeros_like(here)).clamp(-max_step, max_step)
        inside = usable & (proposal > low[active]) & (proposal < high[active])
        middle = 0.5 * (low[active] + high[active])
        bounded = torch.minimum(torch.maximum(proposal, low[active]), high[active])
        following = torch.where(found, torch.where(inside, proposal, middle), bounded)
        depth[active] = following
        # Without a bracket, a line that may not move has nowhere else to look.
        moves = found | (newton & (following != here))
        active = active[(residual.abs() > tolerance) & moves]
    return Roots(best_depth, best_residual, slopes)
