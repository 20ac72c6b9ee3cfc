"""Plans as the simulator receives them: three messages that belong together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.errors import OctnError
from octn_ros.nodes import conversions, qos, status
from octn_ros.planning import quaternions_xyzw
from octn_ros.simulation import LaserPath

SAME_PLACE_M = 1e-6  # float32 of the tool path against float64 of the waypoints, at a metre from the flange
SAME_TURN = 1e-6  # the same of the numbers of a quaternion


class PlanInbox:
    """Subscribes to `waypoints`, `tool_path` and `plan_status`, and hands plans over once both halves are here.

    Args:
        node: the node that listens.
        received: called with each whole plan.
        withdrawn: called when the planner takes its plan back, by empty waypoints or an empty tool path.
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
        self._was_alive = False
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

    def lose(self) -> bool:
        """Return whether the planner has been lost since this was last asked; what it said is forgotten then."""
        was, self._was_alive = self._was_alive, self.planner_alive
        if not was or self._was_alive:
            return False
        self._waypoints = self._tool_path = self._report = None
        return True

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
        if message.poses:
            self._join()
        else:
            self._withdrawn()

    def _on_tool_path(self, message: PointCloud2) -> None:
        self._tool_path = message
        if message.width * message.height:
            self._join()
        else:
            self._withdrawn()

    def _join(self) -> None:
        """Two plans of one scan have equal stamps, so the poses are held against each other too."""
        waypoints, tool_path = self._waypoints, self._tool_path
        if waypoints is None or tool_path is None or waypoints.header.stamp != tool_path.header.stamp:
            return
        try:
            poses, rows = conversions.poses_to_matrices(waypoints.poses), conversions.cloud_to_tool_path(tool_path)
            if len(rows) != len(poses) or not _same_poses(rows, poses):
                return  # one of the two belongs to another plan; its partner is still to come
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


def _same_poses(rows: NDArray[np.void], poses: NDArray[np.float64]) -> bool:
    numbers = np.stack([rows[name].astype(np.float64) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")], axis=-1)
    turns = quaternions_xyzw(poses)
    # A quaternion and its negative are one rotation. NaN is near nothing.
    sign = np.where(np.sum(numbers[:, 3:] * turns, axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    near = np.abs(numbers[:, :3] - poses[:, :3, 3]) <= SAME_PLACE_M
    return bool(near.all() and np.all(np.abs(sign * numbers[:, 3:] - turns) <= SAME_TURN))
