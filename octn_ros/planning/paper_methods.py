"""Newton and SGD exactly as the paper states them, to compare with; `find_surface` is what to plan with."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from octn_ros.errors import PlanError
from octn_ros.field import Field
from octn_ros.planning.axial_root import AxialLines
from octn_ros.planning.raster import RasterPattern
from octn_ros.planning.refinement import SmoothObjective, gradient_descent, turn_mask
from octn_ros.planning.search_result import SurfaceSearch
from octn_ros.planning.surface_search import axial_lines, check_inside
from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class PaperConfig:
    """What the paper states, and stated choices where it leaves something open."""

    warmup_candidates: int = setting(
        256, "N_warmup, candidate depths over the whole axial range (open in the paper)", low=3, high=100_000
    )
    newton_steps: int = setting(10, "Newton steps (open in the paper)", low=1, high=1000)
    min_gradient: float = setting(
        1e-3, "gradient per axial voxel below which a step is skipped (open in the paper)", low=1e-9, high=1.0
    )
    max_step_voxels: float = setting(2.0, "longest Newton step (open in the paper)", unit="voxels", low=1e-3, high=1e3)
    neighbourhood_voxels: float = setting(
        8.0, "N_voxels, how far from the coarse depth a point may go (open in the paper)", unit="voxels", low=0.5,
        high=1e3,
    )  # fmt: skip
    sgd_steps: int = setting(1000, "steps of gradient descent", low=1, high=1_000_000)
    smoothness: float = setting(
        10.0, "lambda, for depths in canonical coordinates (the unit is open)", low=0.0, high=1e9
    )
    learning_rate: float = setting(
        5e-4, "step per unit of gradient by canonical depth (open in the paper)", low=1e-12, high=1.0
    )

    def __post_init__(self) -> None:
        check_settings(self)


def paper_newton(
    field: Field, pattern: RasterPattern, tau: float | None = None, config: PaperConfig | None = None
) -> SurfaceSearch:
    """Find the surface as the paper does: eqs. 8, 10 and 11, with the safeguards it names.

    Each point starts at the candidate depth with the largest finite difference over the whole A-scan. Newton's slope
    is the central difference over half an axial voxel on either side. A step is skipped where the slope is too small,
    clamped, and kept near the start. Nothing is given up.

    Args:
        field: the field, neural or interpolated.
        pattern: raster points in the OCT frame.
        tau: intensity of the surface; if left out, the median intensity of the coarse points.
        config: what the paper leaves open.

    Raises:
        PlanError: a point lies outside the field, or tau is not positive.
    """
    config = config or PaperConfig()
    lines, start, level, began, coarse_done = _coarse(field, pattern, tau, config)
    low, high = start - config.neighbourhood_voxels, start + config.neighbourhood_voxels
    every = torch.arange(len(start), device=start.device)
    depth = start.clone()
    for _ in range(config.newton_steps):
        # epsilon is half an axial voxel: 1 / (H - 1) in canonical coordinates.
        before, value, after = lines.values(depth[:, None] + depth.new_tensor([-0.5, 0.0, 0.5]), every).unbind(dim=1)
        slope = after - before
        step = torch.where(slope.abs() >= config.min_gradient, (value - level) / slope, torch.zeros_like(slope))
        depth = depth - step.clamp(-config.max_step_voxels, config.max_step_voxels)
        depth = torch.minimum(torch.maximum(depth, low), high)
    method = (
        f"the paper's Newton: {config.newton_steps} steps with central differences over half a voxel, from the largest "
        f"gradient of {config.warmup_candidates} candidates"
    )
    return _result(lines, start, depth, level, method, began, coarse_done)


def paper_sgd(
    field: Field, pattern: RasterPattern, tau: float | None = None, config: PaperConfig | None = None
) -> SurfaceSearch:
    """Find a smooth path as the paper does: eqs. 12 to 14 by gradient descent over all points at once.

    The gradients are exact. z under lambda is in canonical coordinates here, in which the paper states its epsilon; in
    axial voxels the same lambda would weigh ((H - 1) / 2)^2 times as much. Nothing is given up.

    Args:
        field: the field, neural or interpolated.
        pattern: raster points in the OCT frame and their lines.
        tau: intensity of the surface; if left out, the median intensity of the coarse points.
        config: what the paper leaves open.

    Raises:
        PlanError: a point lies outside the field, or tau is not positive.
    """
    config = config or PaperConfig()
    lines, start, level, began, coarse_done = _coarse(field, pattern, tau, config)
    voxels_per_canonical = lines.last / 2.0
    objective = SmoothObjective(
        lines,
        torch.full_like(start, level),
        torch.ones_like(start),
        turn_mask(pattern.segment),
        config.smoothness / voxels_per_canonical**2,
    )
    depth = gradient_descent(
        objective,
        start,
        start - config.neighbourhood_voxels,
        start + config.neighbourhood_voxels,
        config.sgd_steps,
        # The same step of the path, told in voxels: dz is scaled once as a length and once as a derivative.
        config.learning_rate * voxels_per_canonical**2,
    )
    method = (
        f"the paper's SGD: {config.sgd_steps} steps of {config.learning_rate:g}, lambda {config.smoothness:g} for z in "
        f"canonical coordinates, from the largest gradient of {config.warmup_candidates} candidates"
    )
    return _result(lines, start, depth, level, method, began, coarse_done)


def _coarse(
    field: Field, pattern: RasterPattern, tau: float | None, config: PaperConfig
) -> tuple[AxialLines, Tensor, float, float, float]:
    """Return lines, coarse depths in axial voxels (eq. 8), tau, and the times before and after."""
    points = np.asarray(pattern.points_m, dtype=np.float64)
    check_inside(field.geometry, points)
    if tau is not None and not tau > 0:
        raise PlanError(f"expected a positive surface intensity tau, got {tau}")
    began = time.perf_counter()
    lines = axial_lines(field, points)
    every = torch.arange(len(points), device=field.device)
    candidates = torch.linspace(0.0, lines.last, config.warmup_candidates, device=field.device)
    values = lines.values(candidates.expand(len(points), -1), every)
    steepest = (values[:, 1:] - values[:, :-1]).abs().argmax(dim=1)
    start = 0.5 * (candidates[steepest] + candidates[steepest + 1])
    if tau is None:
        tau = float(lines.values(start[:, None], every).median())
    return lines, start, tau, began, time.perf_counter()


def _result(
    lines: AxialLines, start: Tensor, depth: Tensor, tau: float, method: str, began: float, coarse_done: float
) -> SurfaceSearch:
    ended = time.perf_counter()
    geometry = lines.field.geometry
    intensity = lines.values(depth[:, None], torch.arange(len(depth), device=depth.device))[:, 0].cpu().numpy()

    def metres(voxels: Tensor) -> NDArray[np.float64]:
        return np.asarray(geometry.origin_m[2] + voxels.cpu().numpy().astype(np.float64) * geometry.spacing_m[1])

    return SurfaceSearch.untested(
        depth_m=metres(depth),
        intensity=intensity.astype(np.float64),
        tau=tau,
        coarse_depth_m=metres(start),
        method=method,
        seconds={"coarse": coarse_done - began, "refine": ended - coarse_done},
    )
