"""Whether a waypoint can be trusted: its A-scans, the coarse surface and its neighbours have a say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.planning.coarse_surface import CoarseSurface
from octn_ros.planning.give_up import GiveUp
from octn_ros.planning.neighbours import allowed_deviation, deviation_from_neighbours, share_of_neighbours
from octn_ros.settings import check_settings, setting
from octn_ros.volume import VolumeGeometry

# Scatter of the neighbours below which none of them is doubted.
_FLOOR_M = 3e-6
# Deviation from the neighbours that is no outlier's however little they scatter.
_SMALLEST_OUTLIER_M = 11e-6
# Share of given-up neighbours from which a waypoint lies beside a place that cannot be seen: what hides it has bent the
# level set around it already, so no more than the smallest outlier's deviation is allowed. Lone ones are speckle.
_DOUBTFUL_SHARE = 0.15
# Scatter of the neighbours that halves the confidence: the axial voxel of the scanner it was tuned on.
_HALVING_SCATTER_M = 14.6e-6


@dataclass(frozen=True)
class TrustConfig:
    """What a waypoint needs to be published."""

    min_step: float = setting(
        0.35,
        "step from air to tissue, as a share of the usual one, below which a waypoint is given up",
        low=0.0,
        high=1.0,
    )
    min_clearness: float = setting(0.2, "how much weaker another step above it must be, as a share", low=0.0, high=1.0)
    max_glare: float = setting(
        0.3, "brightness of the air above it over the usual, as a share of the usual step", low=0.0, high=10.0
    )
    neighbours: int = setting(24, "waypoints around it whose plane it is held against", low=4, high=200)
    outlier_m: float = setting(
        33e-6, "largest distance along the beam from that plane, where the neighbours scatter; less where they do not",
        unit="m", low=1e-6, high=5e-3,
    )  # fmt: skip
    max_scatter_m: float = setting(
        22e-6, "largest scatter of the neighbours about their plane (standard deviation)", unit="m", low=1e-7, high=5e-3
    )
    coarse_m: float = setting(
        44e-6, "largest distance from the coarse surface, less the usual one; on a slope of 1 twice that", unit="m",
        low=1e-6, high=5e-3,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_settings(self)


def judge(
    geometry: VolumeGeometry,
    surface: CoarseSurface,
    points: NDArray[np.float64],
    root: NDArray[np.float64],
    coarse: NDArray[np.float64],
    reason: NDArray[np.int8],
    trust: TrustConfig,
    doubted: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Say which roots are not to be trusted, and how far the others are.

    A root is given up where its A-scans show no clear step from air to tissue, where it lies too far from the coarse
    surface or from a robust surface through its neighbours, and where the neighbours themselves do not agree. Beside
    many that are given up it has to lie closer to the others, and to the coarse surface even on a slope.

    Args:
        geometry: of the field.
        surface: the coarse surface.
        points: lateral places (x, y) [N, 2].
        root: depths [N] in axial voxels.
        coarse: depths of the coarse surface there [N], likewise.
        reason: GiveUp of each point [N]; those of points that are given up here are written into it.
        trust: what is asked of a waypoint.
        doubted: points [N] that count as given up for those beside them, whatever becomes of them; None for no others.

    Returns:
        Confidence [N], 0 to 1; see SurfaceSearch. And the depths [N] in axial voxels at which the neighbours expect a
        point that has a root near the coarse surface; the coarse surface's for the others.
    """
    usual = surface.typical_step
    step = surface.sample(surface.step, points) / usual
    clearness = surface.sample(surface.clearness, points)
    glare = (surface.sample(surface.air, points) - surface.typical_air) / usual
    voxel = geometry.spacing_m[1]
    for wrong, why in (
        (step < trust.min_step, GiveUp.WEAK),
        (clearness < trust.min_clearness, GiveUp.AMBIGUOUS),
        (glare > trust.max_glare, GiveUp.GLARE),
    ):
        reason[(reason == GiveUp.KEPT) & wrong] = why
    kept = reason == GiveUp.KEPT
    usual_away = 0.0
    if kept.any():
        away = root - coarse
        usual_away = float(np.median(away[kept]))
        # A lateral step of the coarse lattice counts for more on a slope.
        steepness = np.hypot(*surface.slope_at(points).T) * voxel
        far = np.abs(away - usual_away) * voxel > trust.coarse_m * (1.0 + steepness)
        reason[kept & far] = GiveUp.OUTLIER
    deviation, scatter = deviation_from_neighbours(
        points,
        np.where(reason == GiveUp.KEPT, root * voxel, np.nan),
        coarse * voxel,
        trust.neighbours,
        _FLOOR_M,
        _SMALLEST_OUTLIER_M,
        trust.outlier_m,
    )
    limit = allowed_deviation(scatter, _SMALLEST_OUTLIER_M, trust.outlier_m)
    reason[(reason == GiveUp.KEPT) & ~(np.abs(deviation) <= limit)] = GiveUp.OUTLIER
    reason[(reason == GiveUp.KEPT) & ~(scatter <= trust.max_scatter_m)] = GiveUp.UNSTEADY
    unseen = reason != GiveUp.KEPT
    lost = share_of_neighbours(points, unseen if doubted is None else unseen | doubted, trust.neighbours)
    away = np.abs(root - coarse - usual_away) * voxel
    bent = (np.abs(deviation) > _SMALLEST_OUTLIER_M) | (away > trust.coarse_m)
    unconfirmed = (lost > _DOUBTFUL_SHARE) & bent
    reason[(reason == GiveUp.KEPT) & unconfirmed] = GiveUp.UNCONFIRMED
    confidence = np.clip(step, 0.0, 1.0) * np.clip(clearness, 0.0, 1.0) / (1.0 + (scatter / _HALVING_SCATTER_M) ** 2)
    return confidence, np.where(np.isfinite(deviation), root - deviation / voxel, coarse + usual_away)
