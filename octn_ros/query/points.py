"""Intensity and gradient of a field at any points in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.field import Field

# Canonical axis (lateral, axial, bscan) along which each metric axis (x, y, z) = (lateral, bscan, axial) runs.
_CANONICAL_AXIS = [0, 2, 1]
_CHUNK_POINTS = 1 << 18
# Points outside by less than this (canonical) lie on the border: coordinates came as float32 through a transform.
_ON_BORDER = 1e-5


@dataclass(frozen=True, eq=False)
class PointIntensities:
    """What a field says at N points; read-only.

    Attributes:
        intensity: 0 to 1 [N], NaN outside the scan.
        gradient_per_m: its gradient by (x, y, z) of the OCT frame, per metre [N, 3], NaN outside the scan.
    """

    intensity: NDArray[np.float32]
    gradient_per_m: NDArray[np.float32]


def evaluate_points(field: Field, points_m: NDArray[np.floating]) -> PointIntensities:
    """Look at a field at points anywhere.

    In chunks, so that memory beyond the answer stays at some 100 MB. Not differentiable; thread-safe; any device.

    Args:
        field: the field to look at.
        points_m: (x, y, z) [N, 3] in the OCT frame; N may be 0, and what is not finite lies outside.
    """
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
    intensity = np.full(len(points), np.nan, dtype=np.float32)
    gradient = np.full((len(points), 3), np.nan, dtype=np.float32)
    metres = np.array(field.geometry.metres_per_canonical)[_CANONICAL_AXIS]
    for start in range(0, len(points), _CHUNK_POINTS):
        canonical = field.geometry.metric_to_canonical(points[start : start + _CHUNK_POINTS])
        # NaN fails this comparison too.
        inside = np.flatnonzero((np.abs(canonical) <= 1.0 + _ON_BORDER).all(axis=1))
        if not len(inside):
            continue
        asked = torch.from_numpy(canonical[inside].clip(-1.0, 1.0).astype(np.float32)).to(field.device)
        values, slopes = field.value_and_gradient(asked)
        intensity[start + inside] = values.cpu().numpy()
        gradient[start + inside] = slopes.cpu().numpy()[:, _CANONICAL_AXIS] / metres
    return PointIntensities(intensity, gradient)
