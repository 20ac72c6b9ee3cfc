"""Intensities at points: whole clouds of them, and the one that was clicked in RViz."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.answers import Answers
from octn_ros.nodes.field_receiver import ReceivedField
from octn_ros.nodes.frames import ScanFrames
from octn_ros.planning import SurfaceSearch, invert
from octn_ros.query import evaluate_points

COLUMNS = ("x", "y", "z", "intensity", "gx", "gy", "gz")
CLICKED_TOPIC = "/clicked_point"  # RViz publishes there, whatever the namespace of the nodes

FieldAndFrames = Callable[[], tuple[ReceivedField, ScanFrames]]
SurfaceUnder = Callable[[ReceivedField, "np.ndarray"], SurfaceSearch]


class PointAnswers:
    """Answers `query_points` on `query_intensity`, and `/clicked_point` on `clicked_surface` and the status topic.

    Points may be stated in any frame that the calibration and the pose of the scan relate to the OCT frame: positions
    and gradients of an answer are those of the asked frame, as it lay at the time of the scan, and the header is that
    of the question. Outside the scan intensity and gradient are NaN. A question that is refused gets no answer on the
    topic, only the reason on the status topic.

    Args:
        node: the node that answers.
        most: returns the largest number of points of a cloud.
        present: returns the present field and its frames, or raises why there is none.
        surface_under: finds the surface under lateral places [N, 2] of a field.
        answers: counts and reports.
        topic: where a clicked point is told of in words and figures.
        group: callback group of the subscriptions.
    """

    def __init__(
        self,
        node: Node,
        most: Callable[[], int],
        present: FieldAndFrames,
        surface_under: SurfaceUnder,
        answers: Answers,
        topic: status.StatusTopic,
        group: CallbackGroup,
    ) -> None:
        self._most, self._present, self._surface_under = most, present, surface_under
        self._answers, self._topic = answers, topic
        self._intensity = node.create_publisher(PointCloud2, "query_intensity", qos.REQUESTS)
        self._clicked = node.create_publisher(PointStamped, "clicked_surface", qos.LATCHED)
        node.create_subscription(PointCloud2, "query_points", self._on_points, qos.REQUESTS, callback_group=group)
        node.create_subscription(PointStamped, CLICKED_TOPIC, self._on_clicked, qos.REQUESTS, callback_group=group)

    def _on_points(self, message: PointCloud2) -> None:
        self._answers.to("query_points", lambda: self._intensity.publish(self._intensities(message)))

    def _intensities(self, message: PointCloud2) -> PointCloud2:
        points = conversions.cloud_to_points(message, self._most())
        received, frames = self._present()
        frame2oct = frames.frame2oct(message.header.frame_id)
        found = evaluate_points(received.field, points @ frame2oct[:3, :3].T + frame2oct[:3, 3])
        # A gradient g of the OCT frame is R^T g in a frame whose axes R turns into the OCT's.
        rows = conversions.table(COLUMNS, points, found.intensity, found.gradient_per_m @ frame2oct[:3, :3])
        stamp_ns = conversions.stamp_to_ns(message.header.stamp)
        return conversions.to_cloud(rows, stamp_ns, message.header.frame_id, max(message.height, 1))

    def _on_clicked(self, message: PointStamped) -> None:
        self._answers.to("clicked_point", lambda: self._tell(message))

    def _tell(self, message: PointStamped) -> None:
        received, frames = self._present()
        frame2oct = frames.frame2oct(message.header.frame_id)
        clicked = np.array([message.point.x, message.point.y, message.point.z])
        point = frame2oct[:3, :3] @ clicked + frame2oct[:3, 3]
        found = evaluate_points(received.field, point[None])
        surface = self._surface_under(received, point[None, :2])
        figures: dict[str, Any] = {
            "state": "clicked",
            **received.identity(),
            **{f"oct_{axis}_m": value for axis, value in zip("xyz", point.tolist(), strict=True)},
            "intensity": float(found.intensity[0]),
        }
        place = " ".join(f"{value * 1e3:.3f}" for value in point)
        words = f"clicked ({place}) mm of the OCT frame: intensity {figures['intensity']:.3f}"
        if surface.given_up[0]:
            self._topic.report(status.WARN, f"{words}, no surface there that can be trusted", figures)
            return
        depth_m = float(surface.depth_m[0])
        figures |= {"surface_depth_m": depth_m, "below_surface_m": float(point[2]) - depth_m}
        figures["confidence"] = float(surface.confidence[0])
        under = invert(frame2oct) @ (point[0], point[1], depth_m, 1.0)
        answer = PointStamped(header=message.header)
        answer.point.x, answer.point.y, answer.point.z = (float(value) for value in under[:3])
        self._clicked.publish(answer)
        self._topic.report(
            status.OK,
            f"{words}, {figures['below_surface_m'] * 1e6:+.0f} um below the surface, which lies at "
            f"{depth_m * 1e3:.3f} mm",
            figures,
        )
