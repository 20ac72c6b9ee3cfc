"""A region as settings: what is planned over when a request does not say."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from octn_ros.errors import PlanError
from octn_ros.planning.region import Region, centred_rectangle_region, polygon_region
from octn_ros.settings import check_settings, setting
from octn_ros.volume import VolumeGeometry


@dataclass(frozen=True)
class RegionConfig:
    """A rectangle about the middle of the scan, or a polygon in the OCT frame."""

    shape: str = setting("rectangle", "form of the region", choices=("rectangle", "polygon"))
    offset_m: tuple[float, float] = setting(
        (0.0, 0.0), "rectangle: its centre (x, y) from the middle of the scan", unit="m"
    )
    size_m: tuple[float, float] = setting(
        (3e-3, 3e-3), "rectangle: length along the lines and across them", unit="m", low=1e-7, high=1.0
    )
    angle_deg: float = setting(
        0.0, "angle of the lines against the lateral axis, towards the bscan axis", unit="deg", low=-360.0, high=360.0
    )
    vertices_m: tuple[float, ...] = setting(
        (0.0, 0.0), "polygon: x and y of its corners in the OCT frame, one after the other", unit="m"
    )

    def __post_init__(self) -> None:
        check_settings(self)

    def region(self, geometry: VolumeGeometry) -> Region:
        """Return the region for a scan of this geometry.

        Raises:
            PlanError: the vertices are no polygon.
        """
        angle_rad = math.radians(self.angle_deg)
        if self.shape == "rectangle":
            middle = np.array(geometry.origin_m[:2]) + 0.5 * np.array(geometry.extent_m[:2])
            return centred_rectangle_region(middle + self.offset_m, self.size_m, angle_rad)
        if len(self.vertices_m) % 2:
            raise PlanError(f"expected x and y of each corner in vertices_m, got {len(self.vertices_m)} numbers")
        return polygon_region(np.reshape(self.vertices_m, (-1, 2)), angle_rad)
