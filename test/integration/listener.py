"""A node that hears a C-scan and does nothing with it: run as a process, the measure of `test_faults_memory`."""

from __future__ import annotations

import sys
from typing import Any

import octn_ros.nodes  # noqa: F401 - makes rclpy importable where ROS 2 is missing

# isort: split
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import Image

from octn_ros.nodes import conversions, process, qos, status

COUNT = int(sys.argv[1])


class Listener(Node):
    """Says `received`, with the stamp of its first image, of each C-scan that came in whole."""

    def __init__(self) -> None:
        super().__init__("listener", namespace="octn/plain")
        self._progress = status.StatusTopic(self, "fit_progress", qos.REPORTS)
        self._heard: list[Any] = []
        profile = qos.scan_profile(COUNT)
        self.create_subscription(Image, "bscan", self._on_image, profile)
        self.create_subscription(PoseStamped, "bscan_pose", lambda message: None, profile)

    def _on_image(self, message: Image) -> None:
        self._heard.append(message.header.stamp)
        if len(self._heard) == COUNT:
            stamp_ns = conversions.stamp_to_ns(self._heard[0])
            self._heard.clear()
            self._progress.report(status.OK, "received", {"state": "received", "stamp_ns": stamp_ns})


if __name__ == "__main__":
    sys.exit(process.run(Listener, [sys.argv[0]]))
