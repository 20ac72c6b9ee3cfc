"""The pose of the end effector at the time of each of the last scans, as the trainer tells it on `scan_ee_pose`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from octn_ros.errors import OctnError
from octn_ros.nodes import conversions, qos

KEPT = 8  # scans: the pose of a scan comes before its field


class ScanPoses:
    """Subscribes to `scan_ee_pose` and keeps the last few, by the time of their scan; a bad one is logged.

    Args:
        node: the node that listens.
        base_frame: the frame in which poses are expected, the robot's base.
        group: callback group of the subscription.
        changed: told the time of a scan whose pose, known before, is now another one.
    """

    def __init__(
        self,
        node: Node,
        base_frame: str,
        group: CallbackGroup,
        changed: Callable[[int], None] = lambda stamp_ns: None,
    ) -> None:
        self._node, self._base_frame, self._changed = node, base_frame, changed
        self._poses: dict[int, NDArray[np.float64]] = {}
        node.create_subscription(PoseStamped, "scan_ee_pose", self._on_pose, qos.LATCHED, callback_group=group)

    def ee2base(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return the pose [4, 4] of the end effector in the base at the scan of that time, None if not told."""
        return self._poses.get(stamp_ns)

    def _on_pose(self, message: PoseStamped) -> None:
        if message.header.frame_id != self._base_frame:
            self._node.get_logger().error(
                f"scan_ee_pose ignored: expected it in {self._base_frame}, got {message.header.frame_id!r}"
            )
            return
        try:
            pose = conversions.pose_to_matrix(message.pose)
        except OctnError as error:
            self._node.get_logger().error(f"scan_ee_pose ignored: {error}")
            return
        stamp_ns = conversions.stamp_to_ns(message.header.stamp)
        before = self._poses.get(stamp_ns)
        poses = {**self._poses, stamp_ns: pose}
        # Replaced, never changed: other threads read it.
        self._poses = dict(list(poses.items())[-KEPT:])
        if before is not None and not np.array_equal(before, pose):
            self._changed(stamp_ns)
