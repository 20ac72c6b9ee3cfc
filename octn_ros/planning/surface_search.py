"""Depth of the surface under each raster point: coarse search, then refinement on the level set tau."""

from __future__ import annotations

import enum
import math
import time
from dataclasses import dataclass
from dataclasses import field as dataclass_field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.errors import PlanError, QueryError
from octn_ros.field import Field
from octn_ros.planning.axial_root import AxialLines, bracket_rises, refine_roots
from octn_ros.query import SurfaceMap, SurfaceMapConfig, surface_map
from octn_ros.settings import check_settings, setting
from octn_ros.volume import VolumeGeometry

# The coarse lattice reaches beyond the raster by this, so that its border has neighbours too.
_MARGIN_VOXELS, _MARGIN_SHARE = 4, 0.07
_INSIDE_M = 1e-9


class GiveUp(enum.IntEnum):
    """Why a waypoint was given up."""

    KEPT = 0
    NO_CROSSING = 1
    FLAT = 2
    NOT_CONVERGED = 3

    @property
    def text(self) -> str:
        """The reason in words."""
        return _REASONS[self]


_REASONS = {
    GiveUp.KEPT: "kept",
    GiveUp.NO_CROSSING: "the intensity does not rise through tau near the coarse surface",
    GiveUp.FLAT: "the intensity does not rise through tau near the coarse surface, where its gradient is too small",
    GiveUp.NOT_CONVERGED: "the refinement did not come close enough to tau",
}


@dataclass(frozen=True)
class SurfaceSearchConfig:
    """How the surface under a raster is found; lengths along the beam in axial voxels."""

    coarse: SurfaceMapConfig = dataclass_field(default_factory=lambda: SurfaceMapConfig(max_ascans=1024))
    warmup_candidates: int = setting(17, "candidate depths around the coarse surface, N_warmup", low=2, high=1024)
    neighbourhood_voxels: float = setting(
        8.0, "how far from the coarse surface a waypoint may lie", unit="voxels", low=0.5, high=1000.0
    )
    newton_steps: int = setting(8, "largest number of Newton steps before bisection", low=1, high=1000)
    min_gradient: float = setting(
        1e-3, "axial gradient below which a Newton step is skipped", unit="1/voxel", low=1e-9, high=1.0
    )
    max_step_voxels: float = setting(2.0, "longest Newton step", unit="voxels", low=1e-3, high=1000.0)
    convergence: float = setting(0.01, "|f - tau| / tau at which a waypoint is done", low=1e-6, high=0.5)
    tolerance: float = setting(0.05, "|f - tau| / tau above which a waypoint is given up", low=1e-6, high=0.5)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, eq=False)
class SurfaceSearch:
    """The surface under N raster points; read-only.

    Attributes:
        depth_m: axial depth z in the OCT frame [N], NaN where given up.
        intensity: field intensity there [N], NaN where given up.
        residual: intensity less tau [N], NaN where given up.
        confidence: how clearly the coarse surface stands out of its A-scans [N], 0 to 1; see SurfaceMap.
        given_up: points without a trustworthy depth [N].
        reason: GiveUp of each point [N], int8.
        coarse_depth_m: depth of the coarse surface [N].
        method: what was done, in words.
        seconds: time of the stages "coarse" and "refine".
    """

    depth_m: NDArray[np.float64]
    intensity: NDArray[np.float64]
    residual: NDArray[np.float64]
    confidence: NDArray[np.float64]
    given_up: NDArray[np.bool_]
    reason: NDArray[np.int8]
    coarse_depth_m: NDArray[np.float64]
    method: str
    seconds: dict[str, float]


def find_surface(
    field: Field, points_m: NDArray[np.floating], tau: float, config: SurfaceSearchConfig | None = None
) -> SurfaceSearch:
    """Find where the intensity rises through tau under each raster point (eqs. 7 to 11).

    The coarse search (eq. 8) runs on a lattice of A-scans over the raster, whose neighbours outvote speckle; each
    point then samples N_warmup depths around it, brackets the rise nearest to it and refines that by Newton's method
    with exact gradients. Not differentiable; thread-safe; any device.

    Args:
        field: the field, neural or interpolated.
        points_m: raster points (x, y) [N, 2] in the OCT frame, in metres.
        tau: intensity of the surface, greater than 0.
        config: how; the defaults if left out.

    Raises:
        PlanError: there are no points, one is not finite or outside the field, tau is not a positive number, or the
            field has no surface at all.
    """
    config = config or SurfaceSearchConfig()
    geometry = field.geometry
    points = np.asarray(points_m, dtype=np.float64)
    check_inside(geometry, points)
    if not (math.isfinite(tau) and tau > 0):
        raise PlanError(f"expected a positive surface intensity tau, got {tau}")
    began = time.perf_counter()
    surface = _coarse_surface(field, points, config.coarse)
    coarse_m = surface.sample(ndimage.median_filter(surface.depth_m, size=3, mode="nearest"), points)
    coarse_done = time.perf_counter()

    index = geometry.metric_to_voxel(np.column_stack([points, coarse_m]))
    canonical = torch.from_numpy(geometry.voxel_to_canonical(index).astype(np.float32)).to(field.device)
    lines = AxialLines(field, canonical[:, 0].clamp(-1, 1), canonical[:, 2].clamp(-1, 1))
    coarse = torch.from_numpy(index[:, 1].astype(np.float32)).to(field.device)
    brackets = bracket_rises(lines, tau, coarse, config.neighbourhood_voxels, config.warmup_candidates)
    roots = refine_roots(
        lines,
        tau,
        brackets,
        steps=config.newton_steps,
        min_slope=config.min_gradient,
        max_step=config.max_step_voxels,
        tolerance=config.convergence * tau,
    )
    missed = ~(roots.residual.abs() <= config.tolerance * tau)
    flat = roots.slope < config.min_gradient
    reason = torch.where(brackets.found, GiveUp.NOT_CONVERGED, torch.where(flat, GiveUp.FLAT, GiveUp.NO_CROSSING))
    # Without a sign change, a point that is close to tau counts only if it lies on a rise.
    lost = missed | (~brackets.found & flat)
    given_up = lost.cpu().numpy()
    residual = np.where(given_up, np.nan, roots.residual.cpu().numpy().astype(np.float64))
    depth_m = geometry.origin_m[2] + roots.depth.cpu().numpy().astype(np.float64) * geometry.spacing_m[1]
    return SurfaceSearch(
        depth_m=np.where(given_up, np.nan, depth_m),
        intensity=residual + tau,
        residual=residual,
        confidence=surface.sample(surface.confidence, points),
        given_up=given_up,
        reason=torch.where(lost, reason, GiveUp.KEPT).cpu().numpy().astype(np.int8),
        coarse_depth_m=coarse_m,
        method="bracketed Newton with exact gradients and bisection, from a coarse search by the "
        f"{config.coarse.method} in {surface.depth_m.size} A-scans and the median of 3^2 of them",
        seconds={"coarse": coarse_done - began, "refine": time.perf_counter() - coarse_done},
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


def _coarse_surface(field: Field, points_m: NDArray[np.float64], config: SurfaceMapConfig) -> SurfaceMap:
    spacing = np.array([field.geometry.spacing_m[2], field.geometry.spacing_m[0]])
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    margin = np.maximum(_MARGIN_VOXELS * spacing, _MARGIN_SHARE * (high - low))
    low, high = low - margin, high + margin
    try:
        return surface_map(field, config, lateral_range_m=(low[0], high[0]), bscan_range_m=(low[1], high[1]))
    except QueryError as error:
        raise PlanError(f"no surface to plan on: {error}") from error
