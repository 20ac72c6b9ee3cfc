"""A searched surface held against the truth of its phantom: one row of the raster table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.field import InterpolatedField
from octn_ros.metrics import hit_rate, smoothness_energy_mm2, summarise_distance
from octn_ros.planning import RasterPattern, SurfaceSearch
from octn_ros.simulation import Phantom

TOLERANCE = 0.05  # of tau, the paper's


@dataclass(frozen=True, eq=False)
class Judge:
    """What every method on one phantom is held against.

    Attributes:
        phantom: with its true surface and artefacts.
        truth: the noise-free field.
        pattern: the raster.
        baseline: the filtered baseline on the same raster, whose smoothness the others are compared with.
    """

    phantom: Phantom
    truth: InterpolatedField
    pattern: RasterPattern
    baseline: SurfaceSearch

    def row(self, search: SurfaceSearch) -> dict[str, Any]:
        """Return the figures of one search; NaN for what no kept waypoint can tell.

        Smoothness is compared where this search kept a waypoint and both its neighbours, on the same triples for
        itself, the baseline and the true surface: who gives up much is not smoother for it.
        """
        kept = ~search.given_up
        x, y = self.pattern.points_m.T
        points = np.column_stack([self.pattern.points_m, search.depth_m])[kept]
        # The level set is where intensities are compared; the offset correction is for the laser.
        level_set = search.depth_m - search.offset_correction_m
        clear = ~self.phantom.artefact_mask(x, y)
        distance = summarise_distance(self.phantom.surface.distance(points)) if len(points) else None
        own = self._energy(search.depth_m, kept)
        baseline = self._energy(self.baseline.depth_m, kept)
        return {
            "hit_rate": hit_rate(search.intensity / search.tau, 1.0, search.given_up, TOLERANCE),
            "hit_rate_truth": self._hit_rate_truth(level_set, search),
            "given_up": float(np.mean(search.given_up)),
            "kept_outside_artefacts": float(np.mean(kept[clear])) if clear.any() else math.nan,
            "spread_um": distance.spread_um if distance else math.nan,
            "offset_um": distance.offset_um if distance else math.nan,
            "max_um": distance.max_um if distance else math.nan,
            "smoothness_mm2": own,
            "smoothness_ratio": own / baseline if baseline > 0 else math.nan,
            "true_smoothness_ratio": self._energy(self.phantom.surface_depth_m(x, y), kept) / baseline
            if baseline > 0
            else math.nan,
            "waypoints": len(kept),
        }

    def _hit_rate_truth(self, level_set_m: NDArray[np.float64], search: SurfaceSearch) -> float:
        geometry = self.truth.geometry
        points = np.column_stack([self.pattern.points_m, np.nan_to_num(level_set_m)])
        canonical = torch.from_numpy(geometry.metric_to_canonical(points).astype(np.float32)).to(self.truth.device)
        with torch.no_grad():
            intensity = self.truth.evaluate(canonical.clamp(-1.0, 1.0)).cpu().numpy().astype(np.float64)
        return hit_rate(intensity / search.tau, 1.0, search.given_up, TOLERANCE)

    def _energy(self, depth_m: NDArray[np.float64], kept: NDArray[np.bool_]) -> float:
        """Sum of squared second differences over triples of kept neighbours; a gap ends a stretch."""
        segment = self.pattern.segment.astype(np.int64)
        # Every gap starts a new segment, so that no second difference reaches over one.
        stretch = np.cumsum(np.r_[False, (segment[1:] != segment[:-1]) | ~kept[1:] | ~kept[:-1]])
        return smoothness_energy_mm2(depth_m[kept], stretch[kept])
