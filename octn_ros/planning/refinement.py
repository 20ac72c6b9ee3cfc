"""Depths that keep to the level set and run smoothly along the raster lines (eqs. 12 to 14)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from torch import Tensor

from octn_ros.planning.axial_root import AxialLines

# Keeps the normal equations definite where a point has no slope and no neighbours, in (intensity / voxel)^2.
_RIDGE = 1e-6
_LARGEST_DAMPING = 1e3


@dataclass(frozen=True, eq=False)
class SmoothObjective:
    """The joint objective of eq. 14: sum_i w_i (f(z_i) - tau_i)^2 + lambda sum_i v_i (z_(i+1) - 2 z_i + z_(i-1))^2.

    Depths are in axial voxels here and under lambda.

    Attributes:
        lines: the lines that the points move along.
        tau: intensity of the surface on each line [N].
        weight: w [N], 1 for points that are held to the level set and 0 for those that only follow their neighbours.
        mask: v [N - 2], 1 where point i + 1 is smoothed with its neighbours, 0 across a turn.
        smoothness: lambda.
    """

    lines: AxialLines
    tau: Tensor
    weight: Tensor
    mask: NDArray[np.float64]
    smoothness: float

    def residual_and_slope(self, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Return f - tau [N] and its exact derivative by depth [N] per axial voxel."""
        every = torch.arange(len(depth), device=depth.device)
        value, slope = self.lines.value_and_slope(depth, every)
        return value - self.tau, slope

    def value(self, residual: Tensor, depth: Tensor) -> float:
        """Return the objective at depths [N] with residuals [N]."""
        second = np.diff(depth.cpu().numpy().astype(np.float64), 2)
        surface = float((self.weight * residual.square()).sum())
        return surface + self.smoothness * float(np.sum(self.mask * second**2))


def turn_mask(
    segment: NDArray[np.integer], depth: NDArray[np.floating] | None = None, break_voxels: float = np.inf
) -> NDArray[np.float64]:
    """Return the mask v [N - 2] of eq. 13: 1 where a point and both its neighbours belong to one segment.

    Args:
        segment: segment of each point [N].
        depth: depths in axial voxels [N]; where their second difference exceeds `break_voxels` the surface breaks, as
            at a step, and is not smoothed.
        break_voxels: how far.
    """
    inside = (segment[2:] == segment[1:-1]) & (segment[1:-1] == segment[:-2])
    if depth is not None:
        inside &= np.abs(np.diff(depth, 2)) <= break_voxels
    return inside.astype(np.float64)


def gradient_descent(
    objective: SmoothObjective, start: Tensor, low: Tensor, high: Tensor, steps: int, learning_rate: float
) -> Tensor:
    """Minimise by plain gradient descent over all points at once, as the paper does (its "SGD").

    Exact gradients.

    Args:
        objective: what is minimised.
        start: coarse depths [N] in axial voxels.
        low: shallowest depths that any step may reach [N].
        high: deepest depths [N].
        steps: number of steps.
        learning_rate: step length per unit of gradient by depth in axial voxels.
    """
    depth = start.clone()
    mask = torch.from_numpy(objective.mask).to(start)
    for _ in range(steps):
        residual, slope = objective.residual_and_slope(depth)
        gradient = 2.0 * objective.weight * residual * slope
        bend = 2.0 * objective.smoothness * mask * (depth[2:] - 2.0 * depth[1:-1] + depth[:-2])
        gradient[2:] += bend
        gradient[1:-1] -= 2.0 * bend
        gradient[:-2] += bend
        depth = torch.minimum(torch.maximum(depth - learning_rate * gradient, low), high)
    return depth


def least_squares(
    objective: SmoothObjective, start: Tensor, low: Tensor, high: Tensor, iterations: int, tolerance: float
) -> Tensor:
    """Minimise the same objective as the sparse non-linear least squares that it is (Levenberg-Marquardt).

    Each step linearises f about the present depths with exact gradients and solves the pentadiagonal normal equations,
    at a cost proportional to the number of points; a step that raises the objective is taken back and damped.

    Args:
        objective: what is minimised.
        start: first depths [N] in axial voxels, roots of the level set for instance.
        low: shallowest depths allowed [N].
        high: deepest depths allowed [N].
        iterations: largest number of steps.
        tolerance: longest movement of any point in voxels at which it is done.
    """
    depth = torch.minimum(torch.maximum(start, low), high)
    bands = _smoothness_bands(objective.mask, objective.smoothness)
    residual, slope = objective.residual_and_slope(depth)
    best, damping = objective.value(residual, depth), 0.0
    for _ in range(iterations):
        step = _step(objective, bands, depth, residual, slope, damping)
        proposal = torch.minimum(torch.maximum(depth + step, low), high)
        moved = float((proposal - depth).abs().max())
        next_residual, next_slope = objective.residual_and_slope(proposal)
        value = objective.value(next_residual, proposal)
        if value <= best:
            depth, residual, slope, best, damping = proposal, next_residual, next_slope, value, 0.1 * damping
            if moved <= tolerance:
                break
        else:
            damping = max(10.0 * damping, 1e-3)
            if damping > _LARGEST_DAMPING:
                break
    return depth


def _step(
    objective: SmoothObjective,
    bands: NDArray[np.float64],
    depth: Tensor,
    residual: Tensor,
    slope: Tensor,
    damping: float,
) -> Tensor:
    weight, z, r, s = (t.cpu().numpy().astype(np.float64) for t in (objective.weight, depth, residual, slope))
    matrix = bands.copy()
    matrix[2] += weight * s**2 + _RIDGE
    matrix[2] *= 1.0 + damping
    bend = objective.smoothness * objective.mask * np.diff(z, 2)
    gradient = weight * r * s
    gradient[2:] += bend
    gradient[1:-1] -= 2.0 * bend
    gradient[:-2] += bend
    step = solveh_banded(matrix, -gradient, overwrite_ab=True, check_finite=False)
    return torch.from_numpy(step).to(depth)


def _smoothness_bands(mask: NDArray[np.float64], smoothness: float) -> NDArray[np.float64]:
    """Return lambda D'VD in the upper banded form of scipy, [3, N]."""
    count = len(mask) + 2
    bands = np.zeros((3, count))
    v = smoothness * mask
    bands[2, 2:] += v
    bands[2, 1:-1] += 4.0 * v
    bands[2, :-2] += v
    bands[1, 1:-1] -= 2.0 * v
    bands[1, 2:] -= 2.0 * v
    bands[0, 2:] += v
    return bands
