"""Roots of f - tau along axial lines: bracket, safeguarded Newton, bisection (eqs. 8 to 11)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from octn_ros.field import Field

# Halving an interval of a voxel this often ends below the resolution of float32.
_BISECTIONS = 20
# Points of the aperture: the middle, and rings of them with equal area for each point.
_RINGS = (6, 12)


@dataclass(frozen=True)
class AxialLines:
    """Lines along the beam through a field, one for each raster point; depths along them are in axial voxels.

    With an aperture a line answers the mean of the field over a disc around it that leans as the surface does, which
    takes speckle out of a field that has it. Without one it answers the field itself.

    Attributes:
        field: the field they run through.
        lateral: canonical lateral coordinate of each line [N], on the field's device.
        bscan: canonical B-scan coordinate of each line [N].
        disc: offsets [P, 2] of the aperture's points along (lateral, bscan) in canonical coordinates, or None.
        lean: axial voxels per canonical unit along (lateral, bscan) of each line's disc [N, 2], or None.
    """

    field: Field
    lateral: Tensor
    bscan: Tensor
    disc: Tensor | None = None
    lean: Tensor | None = None

    @property
    def last(self) -> float:
        """Depth of the deepest voxel."""
        return float(self.field.geometry.shape[1] - 1)

    def some(self, lines: Tensor) -> AxialLines:
        """Return the lines with index [M] alone."""
        lean = None if self.lean is None else self.lean[lines]
        return AxialLines(self.field, self.lateral[lines], self.bscan[lines], self.disc, lean)

    def values(self, depth: Tensor, lines: Tensor) -> Tensor:
        """Return the intensity [M, K] at depths [M, K] of the lines with index [M]."""
        if self.disc is None or self.lean is None:
            return self.field.axial_lines(self.lateral[lines], self.bscan[lines], self._canonical(depth))
        lateral, bscan, shift = self._spread(lines)
        points = len(self.disc)
        deep = (depth[:, None, :] + shift[:, :, None]).reshape(-1, depth.shape[1])
        values = self.field.axial_lines(lateral.reshape(-1), bscan.reshape(-1), self._canonical(deep))
        return values.view(-1, points, depth.shape[1]).mean(dim=1)

    def value_and_slope(self, depth: Tensor, lines: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensity [M] and its exact derivative by depth [M], per axial voxel."""
        if self.disc is None or self.lean is None:
            place = self.lateral[lines], self._canonical(depth), self.bscan[lines]
            value, slope = self.field.axial_value_and_slope(*place)
            return value, slope * (2.0 / self.last)
        lateral, bscan, shift = self._spread(lines)
        deep = self._canonical(depth[:, None] + shift)
        value, slope = self.field.axial_value_and_slope(lateral.reshape(-1), deep.reshape(-1), bscan.reshape(-1))
        shape = (-1, len(self.disc))
        return value.view(shape).mean(dim=1), slope.view(shape).mean(dim=1) * (2.0 / self.last)

    def _canonical(self, depth: Tensor) -> Tensor:
        return depth * (2.0 / self.last) - 1.0

    def _spread(self, lines: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return canonical places and the shift in voxels of every point of the discs, [M, P] each."""
        assert self.disc is not None
        assert self.lean is not None
        lateral = self.lateral[lines][:, None] + self.disc[:, 0]
        bscan = self.bscan[lines][:, None] + self.disc[:, 1]
        # Points beyond the scan are pulled to its border, and their share of the lean with them.
        inside = lateral.clamp(-1, 1), bscan.clamp(-1, 1)
        lean = self.lean[lines]
        along = (inside[0] - self.lateral[lines][:, None]) * lean[:, :1]
        across = (inside[1] - self.bscan[lines][:, None]) * lean[:, 1:]
        return inside[0], inside[1], along + across


def aperture_disc(radius: float) -> list[tuple[float, float]]:
    """Return the points (x, y) of an aperture of that radius: one in the middle, the others on two rings."""
    points, inside, count = [(0.0, 0.0)], 1, 1 + sum(_RINGS)
    for ring in _RINGS:
        distance = radius * math.sqrt((inside + ring / 2) / count)
        points += [
            (distance * math.cos(2 * math.pi * (k + 0.5) / ring), distance * math.sin(2 * math.pi * (k + 0.5) / ring))
            for k in range(ring)
        ]
        inside += ring
    return points


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


def bracket_rises(lines: AxialLines, tau: Tensor, coarse: Tensor, radius: float, candidates: int) -> Brackets:
    """Sample candidate depths around the coarse surface and bracket the rise through tau.

    Of several rises the one that best parts what is below tau from what is above it is taken, by the least sum of
    f - tau down to it. Where no neighbouring candidates lie on either side of tau, the bracket is the whole
    neighbourhood and the start the middle of the steepest rise (eq. 8).

    Args:
        lines: the lines that are searched.
        tau: intensity of the surface on each line [N].
        coarse: coarse depth of each line [N], in axial voxels.
        radius: half width of the neighbourhood in axial voxels.
        candidates: N_warmup, number of depths that are sampled, at least 2.
    """
    every = torch.arange(len(coarse), device=coarse.device)
    offsets = torch.linspace(-radius, radius, candidates, device=coarse.device)
    depth = (coarse[:, None] + offsets).clamp(0.0, lines.last)
    excess = lines.values(depth, every) - tau[:, None]
    below, above = excess[:, :-1], excess[:, 1:]
    rises = (below < 0) & (above >= 0)
    found = rises.any(dim=1)
    parting = torch.where(rises, below.cumsum(dim=1), torch.inf)
    chosen = torch.where(found, parting.argmin(dim=1), (above - below).argmax(dim=1))[:, None]
    low, high = depth[:, :-1].gather(1, chosen)[:, 0], depth[:, 1:].gather(1, chosen)[:, 0]
    before, after = below.gather(1, chosen)[:, 0], above.gather(1, chosen)[:, 0]
    share = torch.where(found, before / (before - after), torch.full_like(before, 0.5))
    start = low + (high - low) * share
    return Brackets(torch.where(found, low, depth[:, 0]), torch.where(found, high, depth[:, -1]), start, found)


def refine_roots(
    lines: AxialLines,
    tau: Tensor,
    brackets: Brackets,
    *,
    steps: int,
    min_slope: float,
    max_step: float,
    tolerance: Tensor,
) -> Roots:
    """Refine by Newton's method (eq. 10) with exact gradients, inside each line's bracket.

    Safeguards of the paper: no step where the slope is below `min_slope`, no step longer than `max_step`, none out of
    the neighbourhood. Where a sign change is bracketed, the middle of the bracket takes the place of a refused step,
    and what Newton leaves open is bisected, so that a root that is there is found.

    Args:
        lines: the lines that are refined.
        tau: intensity of the surface on each line [N].
        brackets: where to look.
        steps: largest number of Newton steps.
        min_slope: smallest usable derivative of the intensity per axial voxel.
        max_step: longest step in axial voxels.
        tolerance: residual [N] at which a line is done.
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
            value, slope = lines.values(here[:, None], active)[:, 0], torch.zeros_like(here)
        residual = value - tau[active]
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
        active = active[(residual.abs() > tolerance[active]) & moves]
    return Roots(best_depth, best_residual, slopes)
