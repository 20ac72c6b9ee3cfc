"""What an OCT scanner must do for the trainer, in one node: two topics, and a service that starts a C-scan.

Put your scanner's frame grabber in place of `acquire`. Usage: python examples/minimal_scanner.py
"""

import array
import sys
from collections.abc import Iterator

import numpy as np

import octn_ros.nodes  # noqa: F401 - makes rclpy and the message packages importable where ROS 2 is missing

# isort: split
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

BSCANS, AXIAL, LATERAL = 32, 64, 48
SPACING_M = 28e-6  # from one B-scan to the next
PERIOD_S = 0.01
# The image frame in the OCT frame: x stays lateral, the image's y (down) is z (into the tissue), its z is -y.
IMAGE_TO_OCT_XYZW = (0.5**0.5, 0.0, 0.0, 0.5**0.5)


def acquire() -> Iterator[np.ndarray]:
    """Yield the B-scans [axial, lateral] of one C-scan, uint8: here a bright layer under dark water."""
    noise = np.random.default_rng(0)
    depth = np.arange(AXIAL)[:, None]
    for _ in range(BSCANS):
        layer = np.where(depth > AXIAL // 3, 160.0 * np.exp(-(depth - AXIAL // 3) / 30.0), 15.0)
        yield np.clip(layer + 8.0 * noise.standard_normal((AXIAL, LATERAL)), 0, 255).astype(np.uint8)


class MinimalScanner(Node):
    """Publishes one C-scan on request, each B-scan when it is acquired."""

    def __init__(self) -> None:
        super().__init__("scanner", namespace="octn")
        everything = QoSProfile(depth=BSCANS)  # reliable by default: a lost B-scan costs the C-scan
        self._image = self.create_publisher(Image, "bscan", everything)
        self._pose = self.create_publisher(PoseStamped, "bscan_pose", everything)
        self.create_service(Trigger, "scan", self._scan)
        self._index, self._images, self._begun = 0, iter(()), self.get_clock().now()
        self._timer = self.create_timer(PERIOD_S, self._send)
        self._timer.cancel()
        self.get_logger().info(f"ready: {BSCANS} B-scans of {AXIAL} axial x {LATERAL} lateral on each call of scan")

    def _heard(self) -> bool:
        return self._image.get_subscription_count() > 0 and self._pose.get_subscription_count() > 0

    def _scan(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._index, self._images = 0, acquire()
        self._timer.reset()
        response.success, response.message = True, f"scanning {BSCANS} B-scans"
        if not self._heard():
            response.message += " once a trainer subscribes to bscan and bscan_pose"
        self.get_logger().info(response.message)
        return response

    def _send(self) -> None:
        if self._index == 0 and not self._heard():
            return  # what nobody hears is lost
        grey = next(self._images, None)
        if grey is None:
            self._timer.cancel()
            self.get_logger().info(f"{self._index} B-scans sent")
            return
        # Yours: when the B-scan was acquired, by the same clock as the arm's, however late it is sent. A busy computer
        # sends some late; stamped with that, they would look as if others between them had been lost.
        if self._index == 0:
            self._begun = self.get_clock().now()
        stamp = (self._begun + Duration(seconds=self._index * PERIOD_S)).to_msg()
        image = Image(height=AXIAL, width=LATERAL, encoding="mono8", step=LATERAL)
        image.header.stamp, image.header.frame_id = stamp, "oct_bscan_frame"
        image.data = array.array("B", grey.tobytes())
        pose = PoseStamped()
        pose.header.stamp, pose.header.frame_id = stamp, "oct_optical_frame"
        pose.pose.position.y = self._index * SPACING_M
        turn = pose.pose.orientation
        turn.x, turn.y, turn.z, turn.w = IMAGE_TO_OCT_XYZW
        self._image.publish(image)
        self._pose.publish(pose)
        self._index += 1


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init(args=sys.argv)
    node = MinimalScanner()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
