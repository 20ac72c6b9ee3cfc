"""The surface under a raster, as every method of finding it answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.planning.give_up import GiveUp


@dataclass(frozen=True, eq=False)
class SurfaceSearch:
    """The surface under N raster points; read-only.

    Attributes:
        depth_m: axial depth z in the OCT frame [N], offset correction included, NaN where given up.
        intensity: field intensity on the level set there, before the offset correction [N], NaN where given up.
        residual: intensity less tau [N], NaN where given up.
        confidence: 0 to 1 [N]: height of the step as a share of the usual one, times how clearly it stands out, over
            1 + (scatter of the neighbours / 14.6 um)^2.
        given_up: points without a trustworthy depth [N].
        reason: GiveUp of each point [N], int8.
        tau: intensity of the surface at each point [N].
        coarse_depth_m: depth of the coarse surface [N].
        offset_correction_m: what was added to every depth.
        method: what was done, in words.
        seconds: time of the stages: "coarse", "refine" and, if made, "check".
        root_depth_m: depth of the level set itself, before it is smoothed, offset correction included [N], NaN where
            given up; None from a method that does not find it. Its scatter is that of the measurement.
    """

    depth_m: NDArray[np.float64]
    intensity: NDArray[np.float64]
    residual: NDArray[np.float64]
    confidence: NDArray[np.float64]
    given_up: NDArray[np.bool_]
    reason: NDArray[np.int8]
    tau: NDArray[np.float64]
    coarse_depth_m: NDArray[np.float64]
    offset_correction_m: float
    method: str
    seconds: dict[str, float]
    root_depth_m: NDArray[np.float64] | None = None

    @classmethod
    def untested(
        cls,
        depth_m: NDArray[np.float64],
        intensity: NDArray[np.float64],
        tau: float,
        coarse_depth_m: NDArray[np.float64],
        method: str,
        seconds: dict[str, float],
    ) -> SurfaceSearch:
        """Return what a method found that gives nothing up: full confidence, one tau, no offset correction.

        Args:
            depth_m: see the class, as for the rest.
            intensity, coarse_depth_m, method, seconds: likewise.
            tau: intensity of the surface at every point.
        """
        count = len(depth_m)
        return cls(
            depth_m=depth_m,
            intensity=intensity,
            residual=intensity - tau,
            confidence=np.ones(count),
            given_up=np.zeros(count, dtype=np.bool_),
            reason=np.full(count, GiveUp.KEPT, dtype=np.int8),
            tau=np.full(count, tau),
            coarse_depth_m=coarse_depth_m,
            offset_correction_m=0.0,
            method=method,
            seconds=seconds,
        )
