"""Where the frames lie, on `/tf_static` and `/tf`, from the one calibration that the plans are made with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from octn_ros.errors import OctnError
from octn_ros.nodes import conversions, qos
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.planning import Calibration
from octn_ros.settings import check_settings, setting
from octn_ros.volume.bscan_places import IMAGE2OCT_ROTATION

BSCAN_FRAME = "oct_bscan_frame"
# Absolute, as tf2 has them: one tree for all robots and namespaces; remap them where each robot has its own.
STATIC_TOPIC, MOVING_TOPIC = "/tf_static", "/tf"


@dataclass(frozen=True)
class TransformsConfig:
    """Which transforms are ours to publish."""

    moving: bool = setting(
        True,
        "publish the end effector's pose of ee_pose on /tf; false where the robot's own driver publishes it",
    )

    def __post_init__(self) -> None:
        check_settings(self)


class Transforms:
    """Publishes where the frames lie that the calibration names.

    On `/tf_static`, once and latched: the OCT frame and the laser frame in the end effector's, and the image frame of
    B-scan 0 in the OCT frame. On `/tf`, for each message on `ee_pose` and with its stamp: the end effector in the base.

    These are the frames as they move with the arm. What was found in a scan holds where the arm was at the time of the
    scan, which is the stamp of every message about it.

    Args:
        node: the node that publishes; gets the parameters `transforms.*`.
        calibration: relates the frames and names them.
    """

    def __init__(self, node: Node, calibration: Calibration) -> None:
        self._node, self._calibration = node, calibration
        self._last_ns: int | None = None
        config = ConfigParameters(node, TransformsConfig(), "transforms", read_only=True).config()
        self._static = node.create_publisher(TFMessage, STATIC_TOPIC, qos.LATCHED)
        image2oct = np.eye(4)
        image2oct[:3, :3] = IMAGE2OCT_ROTATION
        now_ns = int(node.get_clock().now().nanoseconds)
        fixed = (
            (calibration.oct2ee, calibration.oct_frame, calibration.ee_frame),
            (calibration.laser2ee, calibration.laser_frame, calibration.ee_frame),
            (image2oct, BSCAN_FRAME, calibration.oct_frame),
        )
        self._static.publish(TFMessage(transforms=[_transform(*between, now_ns) for between in fixed]))
        if config.moving:
            self._moving = node.create_publisher(TFMessage, MOVING_TOPIC, qos.TRANSFORMS)
            # In a group of its own: a plan takes seconds, and the arm is to be seen moving meanwhile.
            group = MutuallyExclusiveCallbackGroup()
            node.create_subscription(PoseStamped, "ee_pose", self._on_ee_pose, qos.STREAM, callback_group=group)

    def _on_ee_pose(self, message: PoseStamped) -> None:
        calibration, stamp_ns = self._calibration, conversions.stamp_to_ns(message.header.stamp)
        if stamp_ns == self._last_ns:
            return  # tf2 warns of data that it has already
        try:
            if message.header.frame_id != calibration.base_frame:
                raise OctnError(f"expected it in {calibration.base_frame}, got {message.header.frame_id!r}")
            ee2base = conversions.pose_to_matrix(message.pose)
            moved = _transform(ee2base, calibration.ee_frame, calibration.base_frame, stamp_ns)
        except OctnError as error:
            self._node.get_logger().warning(f"ee_pose is not published on /tf: {error}", throttle_duration_sec=5.0)
            return
        self._last_ns = stamp_ns
        self._moving.publish(TFMessage(transforms=[moved]))


def _transform(a2b: NDArray[np.float64], a: str, b: str, stamp_ns: int) -> TransformStamped:
    """Return where frame A lies in frame B: the header names B, A is the child."""
    posed = conversions.matrix_to_pose_stamped(a2b, stamp_ns, b)
    message = TransformStamped(header=posed.header, child_frame_id=a)
    place, translation = posed.pose.position, message.transform.translation
    translation.x, translation.y, translation.z = place.x, place.y, place.z
    message.transform.rotation = posed.pose.orientation
    return message
