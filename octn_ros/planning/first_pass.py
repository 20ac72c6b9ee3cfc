"""A first look at the surface, coarse and smooth, along which raster points are spread."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.field import Field
from octn_ros.planning.coarse_surface import CoarseSurfaceConfig, coarse_surface
from octn_ros.planning.raster import DepthAt

# Enough to see slopes, few enough to cost little beside the search itself.
_MAX_ASCANS = 256
_SMOOTHING_CELLS = 1.0


def first_pass(field: Field, points_m: NDArray[np.float64], config: CoarseSurfaceConfig) -> DepthAt:
    """Return the depth of the coarse surface over a raster, smoothed: only its slopes are meant.

    Waves shorter than some 3 % of the raster's side are not seen. Where that matters, the coverage of the plan says
    how far apart the waypoints really lie on the surface.

    Args:
        field: the field, asked in up to 256 A-scans.
        points_m: raster points (x, y) [N, 2] in the OCT frame, inside the field.
        config: how the coarse surface is found.

    Raises:
        PlanError: the field has no surface at all.
    """
    surface = coarse_surface(
        field, points_m, dataclasses.replace(config, max_ascans=min(config.max_ascans, _MAX_ASCANS))
    )
    axial_m = field.geometry.spacing_m[1]
    depth_m = (
        ndimage.gaussian_filter(ndimage.median_filter(surface.depth, 3, mode="nearest"), _SMOOTHING_CELLS) * axial_m
    )
    return lambda places: surface.sample(depth_m, places)
