"""The query node: what the fitted field says about the tissue, without planning anything."""

from __future__ import annotations

import dataclasses
import math
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from octn_ros.errors import OctnError, QueryError
from octn_ros.field.device import DEVICE_DESCRIPTION, torch_device
from octn_ros.nodes import conversions, process
from octn_ros.nodes.field_receiver import FieldReceiver, ReceivedField
from octn_ros.nodes.frames import ScanFrames
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.nodes.worker import run_aside
from octn_ros.planning import (
    RasterPattern,
    SurfaceSearchConfig,
    WaypointConfig,
    find_surface,
    inward_normals,
    load_calibration,
    waypoint_poses,
)
from octn_ros.resources import config_path
from octn_ros.settings import check_settings, setting
from octn_ros.training.warm_up import warm_up_queries

LARGEST_LINE = 1_000_000  # samples of one query


@dataclass(frozen=True)
class QueryNodeConfig:
    """What the query node has to be told."""

    device: str = setting("auto", DEVICE_DESCRIPTION)
    calibration: str = setting("", "calibration file (YAML); empty = the package's config/calibration.yaml")
    tau: float = setting(0.0, "intensity of the surface, 0 to estimate it from the field", low=0.0, high=1.0)
    sample_spacing_m: float = setting(
        50e-6, "distance of the samples of query_surface when the request states none", unit="m", low=1e-7, high=0.1
    )

    def __post_init__(self) -> None:
        check_settings(self)


class Query(Node):
    """Answers questions about the present field.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("query", namespace=namespace, **options)
        self._config = ConfigParameters(self, QueryNodeConfig(), read_only=("device", "calibration"))
        self._search_config = ConfigParameters(self, SurfaceSearchConfig(), "search")
        # Normals are found as the planner finds them; where the focus would lie is not asked here.
        placing = {setting.name for setting in dataclasses.fields(WaypointConfig)} - {"normal_radius_voxels"}
        self._normal_config = ConfigParameters(self, WaypointConfig(), "waypoints", leave_out=placing)
        config = self._config.config()
        self._frames = ScanFrames(load_calibration(config.calibration or config_path("calibration.yaml")))
        # One group for all of them: no answer mixes two fields.
        group = MutuallyExclusiveCallbackGroup()
        device = torch_device(config.device)
        self._fields = FieldReceiver(self, device, self._on_field, self._on_bad_field, group)
        self.create_service(GetPlan, "query_surface", self._query_surface, callback_group=group)
        self.get_logger().info(f"ready: device {device}")
        run_aside(lambda: warm_up_queries(device=device), "warm-up")

    def _on_field(self, received: ReceivedField) -> None:
        self.get_logger().info(f"field {received.hash} of the scan at {received.stamp_ns} ns received")

    def _on_bad_field(self, reason: str) -> None:
        self.get_logger().error(f"field refused, the last one is kept: {reason}")

    def _query_surface(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        try:
            received, poses = self._surface_line(request)
        except OctnError as error:
            self.get_logger().error(f"query_surface refused: {error}")
            return response
        except Exception as error:  # a fault of ours, or memory that ran out: the node and its callers live on
            self.get_logger().error(f"query_surface failed: {type(error).__name__}: {error}")
            return response
        response.plan = conversions.to_path(poses, received.stamp_ns, received.frame)
        return response

    def _surface_line(self, request: GetPlan.Request) -> tuple[ReceivedField, NDArray[np.float64]]:
        received = self._fields.current
        if received is None:
            raise QueryError("expected a fitted field, got none yet; scan or load a C-scan and wait for its fit")
        config, search = self._config.config(), self._search_config.config()
        start, goal = (self._frames.to_oct(pose)[:2, 3] for pose in (request.start, request.goal))
        points = _line(start, goal, conversions.shortest_decimal(request.tolerance) or config.sample_spacing_m)
        line = RasterPattern(points, np.zeros(len(points), dtype=np.int32))
        found = find_surface(received.field, line, config.tau or None, search)
        kept = ~found.given_up
        if not kept.all():
            self.get_logger().warning(f"query_surface: no surface at {np.count_nonzero(~kept)} of {len(kept)} samples")
        surface = np.column_stack([points, found.depth_m])[kept]
        normals = inward_normals(received.field, surface, self._normal_config.config().normal_radius_voxels)
        return received, waypoint_poses(surface, normals, 0.0)


def _line(start: NDArray[np.float64], goal: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """Return points [N, 2] every `spacing_m` from start on, and the goal."""
    length = float(np.linalg.norm(goal - start))
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise QueryError(f"expected a sample spacing (tolerance) of 0 or more metres, got {spacing_m}")
    if length / spacing_m > LARGEST_LINE:
        raise QueryError(f"expected at most {LARGEST_LINE} samples, got {length:g} m every {spacing_m:g} m")
    if length == 0.0:
        return start[None]
    along = np.append(np.arange(0.0, length - 1e-6 * spacing_m, spacing_m), length)
    return start + (along / length)[:, None] * (goal - start)


def main(args: list[str] | None = None) -> int:
    """Run the query node as a process."""
    return process.run(Query, args)


if __name__ == "__main__":
    sys.exit(main())
