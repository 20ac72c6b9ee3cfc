"""What one asks of a field: where the surface is, how bright it is, and pictures of it."""

from octn_ros.query.band_index import BandIndex
from octn_ros.query.bands import PAPER_BANDS, BandPoints, BandQuery, find_band, find_band_exhaustively
from octn_ros.query.distance import DistanceMap, distance_to_mesh, signed_distance
from octn_ros.query.enface_views import enface, layer_mean
from octn_ros.query.files import write_mesh, write_points
from octn_ros.query.lattice import Lattice
from octn_ros.query.mesh import SurfaceMesh, iso_surface
from octn_ros.query.native_surface import native_surface
from octn_ros.query.near_surface import NearSurface
from octn_ros.query.points import PointIntensities, evaluate_points
from octn_ros.query.regions import Box, EnfacePolygon, Region, Sphere, polygon
from octn_ros.query.rendering import RenderConfig, Rendering, render
from octn_ros.query.slice_spec import SliceImage, SliceSpec
from octn_ros.query.slices import Plane, axial_slice, bscan_slice, lateral_slice, plane_slice
from octn_ros.query.surface import SurfaceMap, SurfaceMapConfig, surface_intensity, surface_map

__all__ = [
    "PAPER_BANDS",
    "BandIndex",
    "BandPoints",
    "BandQuery",
    "Box",
    "DistanceMap",
    "EnfacePolygon",
    "Lattice",
    "NearSurface",
    "Plane",
    "PointIntensities",
    "Region",
    "RenderConfig",
    "Rendering",
    "SliceImage",
    "SliceSpec",
    "Sphere",
    "SurfaceMap",
    "SurfaceMapConfig",
    "SurfaceMesh",
    "axial_slice",
    "bscan_slice",
    "distance_to_mesh",
    "enface",
    "evaluate_points",
    "find_band",
    "find_band_exhaustively",
    "iso_surface",
    "lateral_slice",
    "layer_mean",
    "native_surface",
    "plane_slice",
    "polygon",
    "render",
    "signed_distance",
    "surface_intensity",
    "surface_map",
    "write_mesh",
    "write_points",
]
