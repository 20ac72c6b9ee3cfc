"""A node that carries the messages of a plan without planning: run as a process, the measure of `test_large_plan`."""

from __future__ import annotations

import sys
from typing import Any

import octn_ros.nodes  # noqa: F401 - makes rclpy importable where ROS 2 is missing

# isort: split
from geometry_msgs.msg import PoseArray
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.nodes import process, qos

TOPICS = {"waypoints": PoseArray, "waypoints_oct": PoseArray, "tool_path": PointCloud2, "path": Path}


class Carrier(Node):
    """Keeps the messages of the first plan, and sends them again when `carry` is called.

    It listens to no later plan: nobody listens to what is carried either, so neither has to wait for who receives it.
    """

    def __init__(self) -> None:
        super().__init__("carrier", namespace="octn")
        self._stored: dict[str, Any] = {}
        self._again = {
            topic: self.create_publisher(kind, f"{topic}_again", qos.LATCHED) for topic, kind in TOPICS.items()
        }
        self._listening = [
            self.create_subscription(kind, topic, lambda message, topic=topic: self._store(topic, message), qos.LATCHED)
            for topic, kind in TOPICS.items()
        ]
        self.create_service(GetPlan, "carry", self._carry)

    def _store(self, topic: str, message: Any) -> None:
        self._stored[topic] = message

    def _carry(self, _request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        if len(self._stored) == len(TOPICS):
            while self._listening:
                self.destroy_subscription(self._listening.pop())
            for topic, message in self._stored.items():
                self._again[topic].publish(message)
            response.plan = self._stored["path"]
        return response


if __name__ == "__main__":
    sys.exit(process.run(Carrier))
