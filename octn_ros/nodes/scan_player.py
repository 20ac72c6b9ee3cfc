"""The simulated scanner's output: B-scans and their poses, each published when it is due."""

from __future__ import annotations

import threading
from collections import deque

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import Image

from octn_ros.nodes import conversions, qos
from octn_ros.nodes.transforms import BSCAN_FRAME
from octn_ros.simulation import BScan, Scanner
from octn_ros.volume import OCT_FRAME

TIMER_S = 1e-3  # B-scans that come faster than this are sent several at a time


class ScanPlayer:
    """Publishes `bscan` and `bscan_pose`, one C-scan at a time; safe from any thread.

    Args:
        node: the node that speaks.
        bscans: the most that a C-scan has, for the depth of the queues.
        reliability: of both topics, one of `qos.RELIABILITIES`.
    """

    def __init__(self, node: Node, bscans: int, reliability: str = "reliable") -> None:
        self._node = node
        self._lock = threading.Lock()  # over what is still to be sent
        self._unsent: deque[BScan] = deque()
        profile = qos.scan_profile(bscans, reliability)
        self._image = node.create_publisher(Image, "bscan", profile)
        self._pose = node.create_publisher(PoseStamped, "bscan_pose", profile)
        self._timer = node.create_timer(TIMER_S, self._send)
        self._timer.cancel()

    @property
    def unsent(self) -> int:
        """B-scans of the present C-scan that are still to come."""
        return len(self._unsent)

    @property
    def heard(self) -> bool:
        """Whether anybody listens to both topics."""
        return self._image.get_subscription_count() > 0 and self._pose.get_subscription_count() > 0

    def play(self, scanner: Scanner, start_ns: int, period_s: float) -> None:
        """Begin a C-scan.

        Args:
            scanner: what is played.
            start_ns: stamp of B-scan 0, by the node's clock; it may lie ahead.
            period_s: time from one B-scan to the next.
        """
        with self._lock:
            self._unsent.extend(scanner.bscans(start_ns, round(period_s * 1e9)))
            self._timer.reset()

    def cancel(self) -> int:
        """Send nothing more of the present C-scan; return how many B-scans that leaves out."""
        with self._lock:
            left_out = len(self._unsent)
            self._unsent.clear()
            self._timer.cancel()
        return left_out

    def _send(self) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        with self._lock:
            while self._unsent and self._unsent[0].stamp_ns <= now_ns:
                bscan = self._unsent.popleft()
                self._pose.publish(conversions.matrix_to_pose_stamped(bscan.image2oct, bscan.stamp_ns, OCT_FRAME))
                self._image.publish(conversions.to_image(bscan.image, bscan.stamp_ns, BSCAN_FRAME))
            if not self._unsent:
                self._timer.cancel()
