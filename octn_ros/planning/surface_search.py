"""Depth of the surface under each raster point: coarse search, then refinement on the level set tau."""

from __future__ import annotations

import math
import time

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from octn_ros.errors import PlanError
from octn_ros.field import Field
from octn_ros.planning.axial_root import AxialLines, Roots, aperture_disc, bracket_rises, refine_roots
from octn_ros.planning.coarse_surface import CoarseSurface, coarse_surface
from octn_ros.planning.give_up import GiveUp
from octn_ros.planning.raster import RasterPattern
from octn_ros.planning.refinement import SmoothObjective, gradient_descent, least_squares, turn_mask
from octn_ros.planning.search_config import SurfaceSearchConfig
from octn_ros.planning.search_result import SurfaceSearch
from octn_ros.planning.step_levels import substantial
from octn_ros.planning.trust import judge
from octn_ros.volume import VolumeGeometry

_INSIDE_M = 1e-9
# Movement in axial voxels at which the least squares are done: a hundredth of a micrometre or so.
_STILL_VOXELS = 1e-3
# Share of the step from air to tissue that the estimated tau keeps from either.
_APART = 0.25


def find_surface(
    field: Field, pattern: RasterPattern, tau: float | None = None, config: SurfaceSearchConfig | None = None
) -> SurfaceSearch:
    """Find where the intensity rises through tau under each raster point (eqs. 7 to 14).

    A coarse search over a lattice of A-scans (eq. 8), whose neighbours outvote speckle and artefacts; N_warmup depths
    around it at each point, which bracket the rise; Newton's method with exact gradients inside the bracket and
    bisection where it fails; a second look at outliers, where their neighbours expect them; then, if configured, the
    smooth path of eq. 14. What cannot be trusted is given up with its reason. Not differentiable; thread-safe; any
    device.

    Args:
        field: the field, neural or interpolated.
        pattern: raster points (x, y) in the OCT frame and their lines; points that are no raster have segment 0.
        tau: intensity of the surface, greater than 0; if left out, the median over the coarse surface (the paper's).
            Not used where `tau_mode` is local.
        config: how; the defaults if left out.

    Raises:
        PlanError: there are no points, one is not finite or outside the field, tau is not a positive number, or the
            field has no surface at all.
    """
    config = config or SurfaceSearchConfig()
    geometry = field.geometry
    axial_m = geometry.spacing_m[1]
    points = np.asarray(pattern.points_m, dtype=np.float64)
    check_inside(geometry, points)
    if tau is not None and not (math.isfinite(tau) and tau > 0):
        raise PlanError(f"expected a positive surface intensity tau, got {tau}")
    began = time.perf_counter()
    surface = coarse_surface(field, points, config.coarse)
    coarse = surface.depth_at(points)
    levels = _levels(field, surface, points, tau, config)
    coarse_done = time.perf_counter()

    lines = axial_lines(field, points, surface, config.aperture_m)
    start, target = (torch.from_numpy(a.astype(np.float32)).to(field.device) for a in (coarse, levels))
    roots, reason = _roots(lines, target, start, config.neighbourhood_m / axial_m, config)
    root_done = time.perf_counter()

    root = roots.depth.cpu().numpy().astype(np.float64)
    residual = roots.residual.cpu().numpy().astype(np.float64)
    unjudged = reason.copy()
    confidence, expected = judge(geometry, surface, points, root, coarse, reason, config.trust)
    checked = time.perf_counter()
    outlier = reason == GiveUp.OUTLIER
    second_s = 0.0
    if _look_again(lines, target, expected, np.flatnonzero(outlier), root, residual, config):
        second_s = time.perf_counter() - checked
        reason = unjudged
        confidence, _ = judge(geometry, surface, points, root, coarse, reason, config.trust, outlier)
        checked = time.perf_counter()
    depth = root
    if config.refinement != "newton":
        depth, residual = _smooth(lines, target, start, root, reason, pattern, config)
    ended = time.perf_counter()
    given_up = reason != GiveUp.KEPT
    residual = np.where(given_up, np.nan, residual)
    depth_m, root_m = (geometry.origin_m[2] + d * axial_m + config.offset_correction_m for d in (depth, root))
    return SurfaceSearch(
        depth_m=np.where(given_up, np.nan, depth_m),
        intensity=residual + levels,
        residual=residual,
        confidence=confidence,
        given_up=given_up,
        reason=reason,
        tau=levels,
        coarse_depth_m=geometry.origin_m[2] + coarse * axial_m,
        offset_correction_m=config.offset_correction_m,
        method=f"{config.method} in {surface.depth.size} A-scans",
        seconds={
            "coarse": coarse_done - began,
            "refine": root_done - coarse_done + second_s + ended - checked,
            "check": checked - root_done - second_s,
        },
        root_depth_m=np.where(given_up, np.nan, root_m),
    )


def _roots(
    lines: AxialLines, tau: Tensor, start: Tensor, radius: float, config: SurfaceSearchConfig
) -> tuple[Roots, NDArray[np.int8]]:
    """Return the roots [N] within a radius of the starts [N], in axial voxels, and why there is none [N]."""
    brackets = bracket_rises(lines, tau, start, radius, config.warmup_candidates)
    roots = refine_roots(
        lines,
        tau,
        brackets,
        steps=config.newton_steps,
        min_slope=config.min_gradient,
        max_step=config.max_step_m / lines.field.geometry.spacing_m[1],
        tolerance=config.convergence * tau,
    )
    missed = ~(roots.residual.abs() <= config.tolerance * tau)
    flat = roots.slope < config.min_gradient
    why = torch.where(brackets.found, GiveUp.NOT_CONVERGED, torch.where(flat, GiveUp.FLAT, GiveUp.NO_CROSSING))
    # Without a sign change, a point that is close to tau counts only if it lies on a rise.
    reason = torch.where(missed | (~brackets.found & flat), why, GiveUp.KEPT)
    return roots, reason.cpu().numpy().astype(np.int8)


def _look_again(
    lines: AxialLines,
    tau: Tensor,
    expected: NDArray[np.float64],
    again: NDArray[np.intp],
    depth: NDArray[np.float64],
    residual: NDArray[np.float64],
    config: SurfaceSearchConfig,
) -> bool:
    """Look for another root where its neighbours expect an outlier's: speckle may rise through tau more than once.

    Args:
        lines: every line.
        tau: intensity of the surface on each [N].
        expected: depth in axial voxels that the neighbours expect of each [N].
        again: index of the outliers [M].
        depth: roots [N]; where there is another one it takes the place of the first.
        residual: f - tau there [N], likewise.
        config: how.

    Returns:
        Whether another root was found anywhere.
    """
    if len(again) == 0:
        return False
    some = torch.from_numpy(again).to(tau.device)
    start = torch.from_numpy(expected[again].astype(np.float32)).to(tau.device)
    reach = config.trust.outlier_m / lines.field.geometry.spacing_m[1]
    roots, reason = _roots(lines.some(some), tau[some], start, reach, config)
    found = reason == GiveUp.KEPT
    depth[again[found]] = roots.depth.cpu().numpy()[found]
    residual[again[found]] = roots.residual.cpu().numpy()[found]
    return bool(found.any())


def axial_lines(
    field: Field, points_m: NDArray[np.float64], surface: CoarseSurface | None = None, aperture_m: float = 0.0
) -> AxialLines:
    """Return the lines along the beam through lateral points (x, y) [N, 2], with an aperture that leans as `surface`.

    Args:
        field: the field.
        points_m: where, in the OCT frame.
        surface: the coarse surface; not needed without an aperture.
        aperture_m: radius of the aperture, 0 for none.
    """
    geometry = field.geometry
    canonical = geometry.metric_to_canonical(np.column_stack([points_m, np.full(len(points_m), geometry.origin_m[2])]))
    lateral, bscan = (torch.from_numpy(canonical[:, k].astype(np.float32)).to(field.device) for k in (0, 2))
    if surface is None or aperture_m == 0.0:
        return AxialLines(field, lateral.clamp(-1, 1), bscan.clamp(-1, 1))
    per_canonical = np.array([geometry.metres_per_canonical[0], geometry.metres_per_canonical[2]])
    disc = np.array(aperture_disc(aperture_m)) / per_canonical
    lean = surface.slope_at(points_m) * per_canonical
    return AxialLines(
        field,
        lateral.clamp(-1, 1),
        bscan.clamp(-1, 1),
        torch.from_numpy(disc.astype(np.float32)).to(field.device),
        torch.from_numpy(lean.astype(np.float32)).to(field.device),
    )


def check_inside(geometry: VolumeGeometry, points_m: NDArray[np.float64], what: str = "raster point") -> None:
    """Refuse lateral points (x, y) [N, 2] that are not finite or lie outside the scan.

    Raises:
        PlanError: names the first such point, what it is, and the range that is allowed.
    """
    if points_m.ndim != 2 or points_m.shape[1] != 2 or len(points_m) == 0:
        raise PlanError(f"expected points (x, y) [N, 2] with N > 0, got an array of shape {points_m.shape}")
    low = np.array(geometry.origin_m[:2])
    high = low + np.array(geometry.extent_m[:2])
    outside = ~((points_m >= low - _INSIDE_M) & (points_m <= high + _INSIDE_M)).all(axis=1)
    if outside.any():
        bad = int(np.argmax(outside))
        x, y = points_m[bad] * 1e3
        raise PlanError(
            f"expected every {what} inside the scan, x from {low[0] * 1e3:.3f} to {high[0] * 1e3:.3f} mm and y from "
            f"{low[1] * 1e3:.3f} to {high[1] * 1e3:.3f} mm in {geometry.frame}, got {what} {bad} at "
            f"({x:.3f}, {y:.3f}) mm; move the raster or scan a larger area"
        )


def _levels(
    field: Field, surface: CoarseSurface, points: NDArray[np.float64], tau: float | None, config: SurfaceSearchConfig
) -> NDArray[np.float64]:
    if config.tau_mode == "local":
        return 0.5 * (surface.sample(surface.air, points) + surface.sample(surface.tissue, points))
    return np.full(len(points), surface_tau(field, surface) if tau is None else tau)


def surface_tau(field: Field, surface: CoarseSurface) -> float:
    """Return tau as the paper estimates it (eq. 7): the median intensity of the coarse surface's points.

    Unlike the paper's it is that of A-scans with tissue, and kept apart from both levels: below a sharp edge that soon
    fades, the middle of the step between them is reached above the edge, so that the median is that of air.
    """
    geometry = field.geometry
    rows, columns = surface.depth.shape
    x, y = np.tile(surface.lateral_m, rows), np.repeat(surface.bscan_m, columns)
    z = geometry.origin_m[2] + surface.depth.ravel() * geometry.spacing_m[1]
    points = geometry.metric_to_canonical(np.column_stack([x, y, z])).astype(np.float32)
    with torch.no_grad():
        levels = field.evaluate(torch.from_numpy(points).to(field.device)).cpu()
    tissue = substantial(surface.step).ravel()
    median, air = float(levels[torch.from_numpy(tissue)].median()), float(np.median(surface.air.ravel()[tissue]))
    step = surface.typical_step
    return min(max(median, air + _APART * step), air + (1.0 - _APART) * step)


def _smooth(
    lines: AxialLines,
    target: Tensor,
    start: Tensor,
    root: NDArray[np.float64],
    reason: NDArray[np.int8],
    pattern: RasterPattern,
    config: SurfaceSearchConfig,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the depths [N] that minimise eq. 14 and their residuals [N]; given-up points follow their neighbours."""
    axial_m = lines.field.geometry.spacing_m[1]
    kept = reason == GiveUp.KEPT
    first = np.where(kept, root, start.cpu().numpy())
    objective = SmoothObjective(
        lines,
        target,
        torch.from_numpy(kept.astype(np.float32)).to(target.device),
        turn_mask(pattern.segment, first, config.break_m / axial_m),
        config.smoothness_per_m2 * axial_m**2,
    )
    from_roots = torch.from_numpy(first.astype(np.float32)).to(target.device)
    # The path may leave a root by little, so that what holds for roots holds for it; elsewhere it is clamped as in the
    # paper.
    leeway = torch.from_numpy(np.where(kept, config.leeway_m / axial_m, np.inf).astype(np.float32)).to(target.device)
    neighbourhood = config.neighbourhood_m / axial_m
    low = torch.maximum(start - neighbourhood, from_roots - leeway)
    high = torch.minimum(start + neighbourhood, from_roots + leeway)
    if config.refinement == "sgd":
        depth = gradient_descent(objective, start, low, high, config.descent_steps, config.descent_rate)
    else:
        depth = least_squares(objective, from_roots, low, high, config.smoothing_steps, _STILL_VOXELS)
    residual, _ = objective.residual_and_slope(depth)
    return depth.cpu().numpy().astype(np.float64), residual.cpu().numpy().astype(np.float64)
