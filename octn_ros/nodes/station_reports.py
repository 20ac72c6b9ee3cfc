"""What the simulator tells of its platform: where the arm is, how the tissue lies, what the laser does and has done."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Bool

from octn_ros.nodes import conversions, qos, status
from octn_ros.simulation import Station
from octn_ros.volume import OCT_FRAME


class StationReports:
    """Publishes `ee_pose`, `tissue_motion`, `laser_on`, `removed_depth` and `execution_status`; safe from any thread.

    Args:
        node: the node that speaks.
        station: the platform.
        lock: over the platform and the order of the reports.
        base_frame: name of the robot's base frame.
        now_ns: tells the time.
    """

    def __init__(
        self, node: Node, station: Station, lock: threading.RLock, base_frame: str, now_ns: Callable[[], int]
    ) -> None:
        self._node, self._station, self._lock = node, station, lock
        self._base_frame, self._now_ns = base_frame, now_ns
        self._shown: bool | None = None
        self._ee_pose = node.create_publisher(PoseStamped, "ee_pose", qos.STREAM)
        self._tissue_motion = node.create_publisher(Vector3Stamped, "tissue_motion", qos.STREAM)
        self._laser_on = node.create_publisher(Bool, "laser_on", qos.LATCHED)
        self._removed_depth = node.create_publisher(Image, "removed_depth", qos.LATCHED)
        self._status = status.StatusTopic(node, "execution_status", qos.REPORTS)

    def values(self) -> dict[str, Any]:
        """Return the state of the platform as named figures."""
        with self._lock:
            station = self._station
            passed, count = station.arm.progress
            return {
                "state": station.arm.state,
                "laser_enabled": station.enabled,
                "laser_on": station.arm.shone,
                "scan_stamp_ns": station.scan_stamp_ns,
                "waypoints": count,
                "passed": passed,
                "shots": station.arm.executed,
                **station.figures(),
            }

    def say(self, level: bytes, message: str, *, log: bool = True) -> None:
        """Publish the state and what there is to say of it."""
        with self._lock:
            self._status.report(level, message, self.values(), log=log)

    def show_motion(self) -> None:
        """Publish where the end effector is, and where the tissue is tracked."""
        with self._lock:
            now_ns = self._now_ns()
            pose, moved_m = self._station.arm.ee2base, self._station.measured_motion_m(now_ns)
        self._ee_pose.publish(conversions.matrix_to_pose_stamped(pose, now_ns, self._base_frame))
        message = Vector3Stamped(header=conversions.header(now_ns, OCT_FRAME))
        message.vector.x, message.vector.y, message.vector.z = (float(value) for value in moved_m)
        self._tissue_motion.publish(message)

    def show_laser(self) -> None:
        """Publish whether the laser is on, if that has changed."""
        with self._lock:
            laser_on = self._station.arm.shone  # also of a shot that is shorter than a step
            if laser_on != self._shown and self._node.context.ok():
                self._shown = laser_on
                self._laser_on.publish(Bool(data=laser_on))

    def show_removed(self) -> None:
        """Publish the truth that only a simulator knows: what is gone at each A-scan of its first scan."""
        with self._lock:
            tissue = self._station.tissue
            if tissue is not None and self._node.context.ok():
                removed = tissue.removed_m.astype(np.float32)
                self._removed_depth.publish(conversions.to_image(removed, self._now_ns(), OCT_FRAME))
