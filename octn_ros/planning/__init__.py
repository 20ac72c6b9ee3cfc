"""From a rectangle on the tissue to waypoints of the laser in the robot's frames."""

from octn_ros.planning.baseline import NativeSurface, baseline_surface, knn_baseline
from octn_ros.planning.calibration import Calibration, calibration_from_dict, load_calibration
from octn_ros.planning.coarse_surface import CoarseSurfaceConfig
from octn_ros.planning.coverage import Coverage, measure_coverage
from octn_ros.planning.envelope import EnvelopeConfig
from octn_ros.planning.error_budget import ErrorBudget, ErrorBudgetConfig, ErrorTerm
from octn_ros.planning.give_up import GiveUp
from octn_ros.planning.keep_out import KeepOut, load_keep_out
from octn_ros.planning.paper_methods import PaperConfig, paper_newton, paper_sgd
from octn_ros.planning.plan import GivenUpPoint, Plan, PlannerConfig, plan_raster, plan_region
from octn_ros.planning.plan_report import plan_to_plain
from octn_ros.planning.raster import RasterConfig, RasterPattern, count_waypoints, raster_pattern, rectangle_raster
from octn_ros.planning.region import (
    Region,
    centred_rectangle_region,
    polygon_region,
    rectangle_corners,
    rectangle_region,
)
from octn_ros.planning.region_config import RegionConfig
from octn_ros.planning.search_config import SurfaceSearchConfig
from octn_ros.planning.search_result import SurfaceSearch
from octn_ros.planning.step_levels import warm_up_steps
from octn_ros.planning.surface_search import check_inside, find_surface
from octn_ros.planning.transforms import from_translation_quaternion, invert, make_rigid, quaternions_xyzw
from octn_ros.planning.trust import TrustConfig
from octn_ros.planning.waypoints import WaypointConfig, Waypoints, inward_normals, place_waypoints, waypoint_poses

__all__ = [
    "Calibration",
    "CoarseSurfaceConfig",
    "Coverage",
    "EnvelopeConfig",
    "ErrorBudget",
    "ErrorBudgetConfig",
    "ErrorTerm",
    "GiveUp",
    "GivenUpPoint",
    "KeepOut",
    "NativeSurface",
    "PaperConfig",
    "Plan",
    "PlannerConfig",
    "RasterConfig",
    "RasterPattern",
    "Region",
    "RegionConfig",
    "SurfaceSearch",
    "SurfaceSearchConfig",
    "TrustConfig",
    "WaypointConfig",
    "Waypoints",
    "baseline_surface",
    "calibration_from_dict",
    "centred_rectangle_region",
    "check_inside",
    "count_waypoints",
    "find_surface",
    "from_translation_quaternion",
    "invert",
    "inward_normals",
    "knn_baseline",
    "load_calibration",
    "load_keep_out",
    "make_rigid",
    "measure_coverage",
    "paper_newton",
    "paper_sgd",
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
    "warm_up_steps",
    "waypoint_poses",
]
