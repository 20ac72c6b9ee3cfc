"""From a rectangle on the tissue to waypoints of the laser in the robot's frames."""

from octn_ros.planning.calibration import Calibration, calibration_from_dict, load_calibration
from octn_ros.planning.plan import GivenUpPoint, Plan, PlannerConfig, plan_raster, plan_to_plain
from octn_ros.planning.raster import RasterConfig, RasterPattern, rectangle_raster
from octn_ros.planning.region import rectangle_corners
from octn_ros.planning.surface_search import GiveUp, SurfaceSearch, SurfaceSearchConfig, find_surface
from octn_ros.planning.transforms import from_translation_quaternion, invert, make_rigid, quaternions_xyzw
from octn_ros.planning.waypoints import WaypointConfig, inward_normals, waypoint_poses

__all__ = [
    "Calibration",
    "GiveUp",
    "GivenUpPoint",
    "Plan",
    "PlannerConfig",
    "RasterConfig",
    "RasterPattern",
    "SurfaceSearch",
    "SurfaceSearchConfig",
    "WaypointConfig",
    "calibration_from_dict",
    "find_surface",
    "from_translation_quaternion",
    "invert",
    "inward_normals",
    "load_calibration",
    "make_rigid",
    "plan_raster",
    "plan_to_plain",
    "quaternions_xyzw",
    "rectangle_corners",
    "rectangle_raster",
    "waypoint_poses",
]
