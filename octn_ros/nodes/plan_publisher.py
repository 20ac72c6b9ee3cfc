"""A plan on the graph: what the robot follows, all of one scan and of one stamp."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.nodes import conversions, qos
from octn_ros.nodes.field_receiver import ReceivedField
from octn_ros.planning import Calibration, Plan


class PlanPublisher:
    """Publishes `waypoints`, `waypoints_base`, `waypoints_oct` and `tool_path`, latched, and withdraws them.

    All are stamped with the time of the scan. Not thread-safe: call it from one callback group.

    Args:
        node: the node that publishes.
        calibration: names the frames.
    """

    def __init__(self, node: Node, calibration: Calibration) -> None:
        self._calibration = calibration
        self._waypoints = node.create_publisher(PoseArray, "waypoints", qos.LATCHED)
        self._waypoints_base = node.create_publisher(PoseArray, "waypoints_base", qos.LATCHED)
        self._waypoints_oct = node.create_publisher(PoseArray, "waypoints_oct", qos.LATCHED)
        self._tool_path = node.create_publisher(PointCloud2, "tool_path", qos.LATCHED)
        self._plan_hash = ""
        self._told = False

    @property
    def told(self) -> bool:
        """Whether anything has been published, a plan or that there is none."""
        return self._told

    @property
    def stands(self) -> bool:
        """Whether a plan is published and not withdrawn."""
        return bool(self._plan_hash)

    @property
    def plan_hash(self) -> str:
        """Identity of the plan that is published and not withdrawn, empty without one."""
        return self._plan_hash

    def publish(self, received: ReceivedField, plan: Plan, ee2base: NDArray[np.float64] | None) -> None:
        """Publish a plan in place of the last one.

        Args:
            received: the field it was made from.
            plan: the plan.
            ee2base: pose of the end effector at the time of the scan; without it there are no waypoints in the base.
        """
        rows = conversions.tool_path(
            plan.waypoints_ee, plan.segment, plan.laser_on, plan.speed_m_s, plan.residual, plan.confidence
        )
        base = np.empty((0, 4, 4)) if ee2base is None else ee2base @ plan.waypoints_ee
        self._plan_hash = self._send(received, rows, plan.waypoints_ee, plan.waypoints_oct, base)

    def withdraw(self, received: ReceivedField) -> None:
        """Publish that there is no plan, stamped with the scan of the new field."""
        nothing = np.empty((0, 4, 4))
        self._send(received, np.empty(0, conversions.TOOL_PATH), nothing, nothing, nothing)
        self._plan_hash = ""

    def _send(
        self,
        received: ReceivedField,
        rows: NDArray[np.void],
        ee: NDArray[np.float64],
        oct_: NDArray[np.float64],
        base: NDArray[np.float64],
    ) -> str:
        stamp_ns, calibration = received.stamp_ns, self._calibration
        tool_path = conversions.to_cloud(rows, stamp_ns, calibration.ee_frame)
        self._tool_path.publish(tool_path)
        self._waypoints_oct.publish(conversions.encode_pose_array(oct_, stamp_ns, received.frame))
        # Without a pose there is nothing to say, except that the old ones are over, maybe those of a planner before.
        if len(base) or self.stands or not self._told:
            self._waypoints_base.publish(conversions.encode_pose_array(base, stamp_ns, calibration.base_frame))
        self._waypoints.publish(conversions.encode_pose_array(ee, stamp_ns, calibration.ee_frame))
        self._told = True
        return conversions.plan_hash(tool_path)
