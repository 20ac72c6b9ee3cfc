"""Plans as the simulator receives them: three messages that belong together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.errors import OctnError
from octn_ros.nodes import conversions, qos, status
from octn_ros.simulation import LaserPath

SAME_PLACE_M = 1e-6  # float32 of the tool path against float64 of the waypoints, at a metre from the flange


class PlanInbox:
    """Subscribes to `waypoints`, `tool_path` and `plan_status`, and hands plans over once both halves are here.

    Args:
        node: the node that listens.
        received: called with each whole plan.
        withdrawn: called when the planner takes its plan back, which it does by empty waypoints.
        refused: called with the reason why messages make no plan.
    """

    def __init__(
        self,
        node: Node,
        received: Callable[[LaserPath], None],
        withdrawn: Callable[[], None],
        refused: Callable[[str], None],
    ) -> None:
        self._received, self._withdrawn, self._refused = received, withdrawn, refused
        self._waypoints: PoseArray | None = None
        self._tool_path: PointCloud2 | None = None
        self._report: DiagnosticArray | None = None
        self._source = node.create_subscription(PoseArray, "waypoints", self._on_waypoints, qos.LATCHED)
        node.create_subscription(PointCloud2, "tool_path", self._on_tool_path, qos.LATCHED)
        node.create_subscription(DiagnosticArray, "plan_status", self._on_report, qos.LATCHED)

    @property
    def planner_alive(self) -> bool:
        """Whether anybody who publishes waypoints is in the graph.

        A planner that is killed leaves the graph when its connection breaks: at once on one machine under the embedded
        runtime, after the lease of the participant (some seconds) under DDS. One that hangs stays in it.
        """
        return self._source.get_publisher_count() > 0

    def origin(self, path: LaserPath) -> tuple[str, str]:
        """Return the node that a plan came from and the hash of its field, empty if no `plan_status` told."""
        report = self._report
        if report is None or not report.status:
            return "", ""
        _, _, values = status.read(report)
        if values.get("stamp_ns") != str(path.stamp_ns) or values.get("waypoints") != str(len(path)):
            return "", ""
        return report.status[0].name.partition(":")[0], values.get("field_hash", "")

    def _on_report(self, message: DiagnosticArray) -> None:
        # Between two plans the planner says other things, refusals for instance, which the standing plan outlives.
        if message.status and status.read(message)[2].get("state") == "planned":
            self._report = message

    def _on_waypoints(self, message: PoseArray) -> None:
        self._waypoints = message
        self._join()

    def _on_tool_path(self, message: PointCloud2) -> None:
        self._tool_path = message
        self._join()

    def _join(self) -> None:
        """Two plans of one scan have equal stamps, so the places are held against each other too."""
        waypoints, tool_path = self._waypoints, self._tool_path
        if waypoints is None or tool_path is None or waypoints.header.stamp != tool_path.header.stamp:
            return
        try:
            poses, rows = conversions.poses_to_matrices(waypoints.poses), conversions.cloud_to_tool_path(tool_path)
            places = np.stack([rows["x"], rows["y"], rows["z"]], axis=-1)
            if len(rows) != len(poses) or np.any(np.abs(places - poses[:, :3, 3]) > SAME_PLACE_M):
                return  # one of the two belongs to another plan; its partner is still to come
            if not len(poses):
                self._withdrawn()
                return
            path = LaserPath(
                poses,
                rows["segment"].astype(np.int32),
                rows["laser_on"].astype(bool),
                rows["speed"].astype(np.float64),
                conversions.stamp_to_ns(waypoints.header.stamp),
                waypoints.header.frame_id,
            )
        except OctnError as error:
            self._refused(str(error))
            return
        self._received(path)
