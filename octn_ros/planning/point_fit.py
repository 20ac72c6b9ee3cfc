"""A rigid transform from matched points (Kabsch), with what each point says about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import CalibrationError
from octn_ros.planning.transforms import from_rotation, nearest_rotation

# Points whose second direction spreads less than this share of the first lie on a line, as far as a fit can tell.
_LINE_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class PointFit:
    """A transform fitted to matched points, and its errors; read-only.

    Attributes:
        a2b: maps points of A into B, 4x4, metres.
        residual_m: distance of each mapped point to its match [N].
        left_out_m: distance of each point to its match when the fit is made without it [N]; NaN where the others do not
            determine one. It tells more about new points than the residuals, which the fit has made small.
    """

    a2b: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    left_out_m: NDArray[np.float64]

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residual_m**2)))

    @property
    def left_out_rms_m(self) -> float:
        """Root mean square of the leave-one-out errors, NaN if none could be made."""
        known = self.left_out_m[np.isfinite(self.left_out_m)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def fit_points(points_a: NDArray[np.float64], points_b: NDArray[np.float64]) -> PointFit:
    """Fit the rigid transform A2B that brings points onto their matches with the least sum of squares (Kabsch).

    Args:
        points_a: (x, y, z) [N, 3] in frame A, in metres.
        points_b: the same points in frame B [N, 3].

    Raises:
        CalibrationError: fewer than 3 points, a number that is not finite, or points on one line.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape:
        raise CalibrationError(f"expected matched points [N, 3] and [N, 3], got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        bad = int(np.argmin(np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)))
        raise CalibrationError(f"expected finite points, got {a[bad].tolist()} and {b[bad].tolist()} at pair {bad}")
    if len(a) < 3:
        raise CalibrationError(f"expected at least 3 matched points, got {len(a)}; 4 or more also tell their errors")
    for name, points in (("first", a), ("second", b)):
        sizes = _spread(points)
        if not sizes[1] > _LINE_SHARE * sizes[0]:
            raise CalibrationError(
                f"expected points that do not lie on one line, got {len(a)} that spread {sizes[0] * 1e3:.3g} mm along "
                f"it and {sizes[1] * 1e3:.3g} mm across it in the {name} frame; the turn about that line stays open"
            )
    a2b = kabsch(a, b)
    left_out = np.full(len(a), np.nan)
    for index in range(len(a)):
        others = np.arange(len(a)) != index
        sizes = _spread(a[others])
        if others.sum() >= 3 and sizes[1] > _LINE_SHARE * sizes[0]:
            left_out[index] = _distance(kabsch(a[others], b[others]), a, b)[index]
    return PointFit(a2b, _distance(a2b, a, b), left_out)


def kabsch(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return A2B [4, 4] with the least sum of squares between mapped a [N, 3] and b [N, 3]; they are not checked."""
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    rotation = nearest_rotation((b - middle_b).T @ (a - middle_a))
    return from_rotation(middle_b - rotation @ middle_a, rotation)


def _distance(a2b: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(a @ a2b[:3, :3].T + a2b[:3, 3] - b, axis=1), dtype=np.float64)


def _spread(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """RMS spread along the three principal directions, largest first."""
    sizes = np.zeros(3)
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    sizes[: len(values)] = values / math.sqrt(len(points))
    return sizes
