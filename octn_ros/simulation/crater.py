"""Tissue that has been taken away: an interface with a crater in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from octn_ros.errors import ConfigurationError
from octn_ros.simulation.interface import Interface


@dataclass(frozen=True, eq=False)
class AblatedSurface(Interface):
    """An interface from which a depth map was taken away: s(x, y) + removed(x, y), bilinear between A-scans.

    Attributes:
        before: the interface before.
        removed_m: depth taken away along z at each A-scan [bscan, lateral], metres, not negative.
        spacing_m: distance between A-scans along (bscan, lateral), metres; the first lies at x = y = 0.
    """

    before: Interface
    removed_m: NDArray[np.float64]
    spacing_m: tuple[float, float]

    def __post_init__(self) -> None:
        removed = np.asarray(self.removed_m)
        if removed.ndim != 2 or min(removed.shape) < 2:
            raise ConfigurationError(f"crater: expected depths [bscan, lateral], got an array of {removed.shape}")
        if not np.isfinite(removed).all() or removed.min() < 0.0:
            raise ConfigurationError(f"crater: expected finite depths of at least 0 m, got one of {removed.min():g} m")

    def removed_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the depth taken away at broadcast `x_m` and `y_m`, metres."""
        row, column = np.broadcast_arrays(
            np.asarray(y_m, dtype=np.float64) / self.spacing_m[0], np.asarray(x_m, dtype=np.float64) / self.spacing_m[1]
        )
        removed = map_coordinates(self.removed_m, [row.ravel(), column.ravel()], order=1, mode="nearest", output=float)
        return np.asarray(removed).reshape(row.shape)

    def depth_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the depth z in metres at lateral `x_m` and bscan `y_m`, metres, broadcast together."""
        return self.before.depth_at(x_m, y_m) + self.removed_at(x_m, y_m)

    def slope_at(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return dz/dx and dz/dy, without unit, at broadcast `x_m` and `y_m`."""
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        slope_x, slope_y = self.before.slope_at(x, y)
        half_y, half_x = self.spacing_m[0] / 2.0, self.spacing_m[1] / 2.0
        # Differences over half an A-scan to each side: the mean of both facets on the edges between them.
        slope_x = slope_x + (self.removed_at(x + half_x, y) - self.removed_at(x - half_x, y)) / self.spacing_m[1]
        slope_y = slope_y + (self.removed_at(x, y + half_y) - self.removed_at(x, y - half_y)) / self.spacing_m[0]
        return slope_x, slope_y

    def curvature_at(
        self, x_m: ArrayLike, y_m: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the second derivatives d2z/dx2, d2z/dxdy and d2z/dy2 in 1/m at broadcast `x_m` and `y_m`."""
        # Facets are flat but for their twist, which only speeds Newton's steps up.
        return self.before.curvature_at(x_m, y_m)
