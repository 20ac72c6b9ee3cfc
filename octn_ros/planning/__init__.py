"""From a rectangle on the tissue to waypoints of the laser in the robot's frames."""

from octn_ros.planning.calibration import Calibration, calibration_from_dict, load_calibration
from octn_ros.planning.coverage import Coverage, measure_coverage
from octn_ros.planning.envelope import EnvelopeConfig
from octn_ros.planning.error_budget import ErrorBudget, ErrorBudgetConfig, ErrorTerm
from octn_ros.planning.keep_out import KeepOut, load_keep_out
from octn_ros.planning.plan import GivenUpPoint, Plan, PlannerConfig, plan_raster, plan_region
from octn_ros.planning.plan_report import plan_to_plain
from octn_ros.planning.raster import RasterConfig, RasterPattern, raster_pattern, rectangle_raster
from octn_ros.planning.region import (
    Region,
    centred_rectangle_region,
    polygon_region,
    rectangle_corners,
    rectangle_region,
)
from octn_ros.planning.region_config import RegionConfig
from octn_ros.planning.surface_search import GiveUp, SurfaceSearch, SurfaceSearchConfig, find_surface
from octn_ros.planning.transforms import from_translation_quaternion, invert, make_rigid, quaternions_xyzw
from octn_ros.planning.waypoints import WaypointConfig, Waypoints, inward_normals, place_waypoints, waypoint_poses

__all__ = [
    "Calibration",
    "Coverage",
    "EnvelopeConfig",
    "ErrorBudget",
    "ErrorBudgetConfig",
    "ErrorTerm",
    "GiveUp",
    "GivenUpPoint",
    "KeepOut",
    "Plan",
    "PlannerConfig",
    "RasterConfig",
    "RasterPattern",
    "Region",
    "RegionConfig",
    "SurfaceSearch",
    "SurfaceSearchConfig",
    "WaypointConfig",
    "Waypoints",
    "calibration_from_dict",
    "centred_rectangle_region",
    "find_surface",
    "from_translation_quaternion",
    "invert",
    "inward_normals",
    "load_calibration",
    "load_keep_out",
    "make_rigid",
    "measure_coverage",
    "place_waypoints",
    "plan_raster",
    "plan_region",
    "plan_to_plain",
    "polygon_region",
    "quaternions_xyzw",
    "raster_pattern",
    "rectangle_corners",
    "rectangle_raster",
    "rectangle_region",
    "waypoint_poses",
]
