"""The layer around a surface map as a region."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from octn_ros.errors import QueryError
from octn_ros.query.regions import Bounds, Coordinates, Mask, Region
from octn_ros.query.surface import SurfaceMap

_ON_BORDER_M = 1e-9


@dataclass(frozen=True, eq=False)
class NearSurface(Region):
    """What lies between two depths about a surface map, within the map's own rectangle.

    Depths are along the beam, in optical path. Between the map's A-scans its depth is interpolated.

    Args:
        surface: the map, from `surface_map`.
        above_m: how far the region reaches above the surface, towards the probe; negative to begin below it.
        below_m: how far it reaches below.

    Raises:
        QueryError: the depths are not finite, or leave nothing between them.
    """

    surface: SurfaceMap
    above_m: float
    below_m: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.above_m) and math.isfinite(self.below_m) and self.above_m + self.below_m > 0.0):
            raise QueryError(
                f"near surface: expected finite depths with above + below > 0, got {self.above_m} and {self.below_m} m"
            )

    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        """Return which points lie inside or on the border; see Region."""
        x, y = np.broadcast_arrays(x_m, y_m)
        depth = self.surface.sample(self.surface.depth_m, np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
        (x0, y0, _), (x1, y1, _) = self.bounds_m()
        over = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
        return np.asarray(over & (z_m >= depth - self.above_m) & (z_m <= depth + self.below_m))

    def bounds_m(self) -> Bounds:
        """Return the box around the region."""
        surface = self.surface
        low = surface.lateral_m[0], surface.bscan_m[0], surface.depth_m.min() - self.above_m
        high = surface.lateral_m[-1], surface.bscan_m[-1], surface.depth_m.max() + self.below_m
        return np.array(low) - _ON_BORDER_M, np.array(high) + _ON_BORDER_M
