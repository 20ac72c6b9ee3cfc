"""What one asks of a field: where the surface is, how bright it is, and pictures of it."""

from octn_ros.query.native_surface import native_surface
from octn_ros.query.slices import bscan_slice, enface
from octn_ros.query.surface import SurfaceMap, SurfaceMapConfig, surface_intensity, surface_map

__all__ = [
    "SurfaceMap",
    "SurfaceMapConfig",
    "bscan_slice",
    "enface",
    "native_surface",
    "surface_intensity",
    "surface_map",
]
