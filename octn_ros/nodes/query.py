"""The query node: what the fitted field says about the tissue, without planning anything."""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import numpy as np
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan, LoadMap
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from octn_ros.errors import OctnError
from octn_ros.field.device import torch_device
from octn_ros.nodes import conversions, process, qos, status
from octn_ros.nodes.answers import Answers
from octn_ros.nodes.band_publisher import BandPublisher, BandRegion
from octn_ros.nodes.diagnostics import NodeDiagnostics
from octn_ros.nodes.field_receiver import FieldReceiver, ReceivedField
from octn_ros.nodes.frames import ScanFrames
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.nodes.point_answers import PointAnswers
from octn_ros.nodes.query_config import QueryLimits, QueryNodeConfig
from octn_ros.nodes.scan_poses import ScanPoses
from octn_ros.nodes.slice_answers import answer_slice
from octn_ros.nodes.surface_line import sample_line, surface_poses, surface_under
from octn_ros.nodes.surface_publisher import SurfacePublisher
from octn_ros.nodes.worker import run_aside
from octn_ros.planning import SurfaceSearch, SurfaceSearchConfig, WaypointConfig, load_calibration
from octn_ros.query import BandQuery, Region, SliceSpec, SurfaceMapConfig
from octn_ros.resources import config_path
from octn_ros.training.warm_up import warm_up_queries


class Query(Node):
    """Answers questions about the present field.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("query", namespace=namespace, **options)
        self._config = ConfigParameters(self, QueryNodeConfig(), read_only=("device", "calibration"))
        # Given at the start only: who can call services raises no limit.
        self._limits = ConfigParameters(self, QueryLimits(), "limits", read_only=True)
        self._search_config = ConfigParameters(self, SurfaceSearchConfig(), "search")
        # Normals are found as the planner finds them; where the focus would lie is not asked here.
        placing = {setting.name for setting in dataclasses.fields(WaypointConfig)} - {"normal_radius_voxels"}
        self._normal_config = ConfigParameters(self, WaypointConfig(), "waypoints", leave_out=placing)
        self._surface_config = ConfigParameters(self, SurfaceMapConfig(), "surface", changed=self._on_surface_config)
        self._band_config = ConfigParameters(
            self, BandQuery(), "band", leave_out=("max_points",), changed=self._on_band_config
        )
        self._band_region = ConfigParameters(self, BandRegion(), "band_region", changed=self._on_band_config)
        config = self._config.config()
        self._calibration = load_calibration(config.calibration or config_path("calibration.yaml"))
        device = torch_device(config.device)

        self._diagnostics = NodeDiagnostics(self, self._describe)
        self._status = status.StatusTopic(self, "query_status", qos.LATCHED)
        self._answers = Answers(self._diagnostics, self._status)
        self._slice = self.create_publisher(Image, "slice", qos.LATCHED)
        self._surface = SurfacePublisher(self, self._surface_config.config, self._failed)
        # Each answer takes the present field once, so no answer mixes two fields.
        services, points, fields = (MutuallyExclusiveCallbackGroup() for _ in range(3))
        self._fields = FieldReceiver(self, device, self._on_field, lambda reason, _: self._failed(reason), fields)
        self._scan_poses = ScanPoses(self, self._calibration.base_frame, fields)
        self._band = BandPublisher(
            self,
            self._wanted_band,
            self._fields,
            lambda reason: self._failed(f"the band is withdrawn: {reason}"),
        )
        self._points = PointAnswers(
            self,
            lambda: self._limits.config().points,
            self._present,
            self._surface_under,
            self._answers,
            self._status,
            points,
        )
        self.create_service(
            GetPlan, "query_surface", self._query_surface, qos_profile=qos.SERVICES, callback_group=services
        )
        self.create_service(
            LoadMap, "query_slice", self._query_slice, qos_profile=qos.SERVICES, callback_group=services
        )
        self.create_service(Trigger, "query_band", self._query_band, qos_profile=qos.SERVICES, callback_group=services)
        self.get_logger().info(f"ready: device {device}")
        run_aside(lambda: warm_up_queries(device=device), "warm-up")

    def destroy_node(self) -> None:
        """End the threads of band and surface, then the node."""
        self._band.close()
        self._surface.close()
        super().destroy_node()

    # --- field and parameters

    def _on_field(self, received: ReceivedField, older: str) -> None:
        identity = {"state": "ready", **received.identity()}
        self._status.report(
            status.WARN if older else status.OK,
            f"field {received.hash} of the scan at {received.stamp_ns} ns received{older}",
            identity,
        )
        self._surface.show(received)
        self._band.refresh()

    def _failed(self, reason: str) -> None:
        self._status.report(status.ERROR, reason, {"state": "refused"})
        self._diagnostics.failed(reason)

    def _on_band_config(self) -> None:
        self._band.refresh()

    def _on_surface_config(self) -> None:
        received = self._fields.current
        if received is not None:
            self._surface.show(received)

    def _describe(self) -> tuple[bytes, str, dict[str, Any]]:
        received = self._fields.current
        if received is None:
            return status.OK, "no field yet", {}
        return status.OK, "ready", {**received.identity(), "field_age_s": self._diagnostics.age_s(received.stamp_ns)}

    def _present(self) -> tuple[ReceivedField, ScanFrames]:
        received = self._fields.required()
        ee2base = self._scan_poses.ee2base(received.stamp_ns)
        return received, ScanFrames(self._calibration, ee2base, received.frame)

    def _wanted_band(self) -> tuple[BandQuery, Region | None]:
        query = dataclasses.replace(self._band_config.config(), max_points=self._limits.config().band_points)
        return query, self._band_region.config().region()

    def _surface_under(self, received: ReceivedField, points_m: NDArray[np.float64]) -> SurfaceSearch:
        return surface_under(received.field, points_m, self._config.config().tau or None, self._search_config.config())

    # --- services

    def _query_surface(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        path, _ = self._answers.to("query_surface", lambda: self._surface_line(request))
        if path is not None:
            response.plan = path
        return response

    def _surface_line(self, request: GetPlan.Request) -> Path:
        received, frames = self._present()
        config = self._config.config()
        start, goal = (frames.to_oct(pose)[:2, 3] for pose in (request.start, request.goal))
        spacing_m = conversions.shortest_decimal(request.tolerance) or config.sample_spacing_m
        points = sample_line(start, goal, spacing_m, self._limits.config().line_samples)
        poses = surface_poses(
            received.field, points, self._surface_under(received, points), self._normal_config.config()
        )
        if len(poses) < len(points):
            self.get_logger().warning(
                f"query_surface: no surface at {len(points) - len(poses)} of {len(points)} samples"
            )
        return conversions.to_path(poses, received.stamp_ns, received.frame)

    def _query_slice(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
        self._answers.to("query_slice", lambda: self._take_slice(request.map_url, response))
        return response

    def _take_slice(self, specification: str, response: LoadMap.Response) -> None:
        try:
            spec = SliceSpec.parse(specification)
        except OctnError:
            response.result = LoadMap.Response.RESULT_INVALID_MAP_METADATA
            raise
        try:
            received = self._fields.required()
            answer = answer_slice(received, spec, self._limits.config().slice_pixels)
        except OctnError:
            response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
            raise
        self._slice.publish(answer.image)
        response.map, response.result = answer.grid, LoadMap.Response.RESULT_SUCCESS
        figures = {"state": "sliced", **received.identity(), **answer.figures}
        self._status.report(status.OK, f"slice {specification} taken", figures, log=False)

    def _query_band(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        text, reason = self._answers.to("query_band", self._band.answer)
        response.success, response.message = text is not None, text or reason
        return response


def main(args: list[str] | None = None) -> int:
    """Run the query node as a process."""
    return process.run(Query, args)


if __name__ == "__main__":
    sys.exit(main())
