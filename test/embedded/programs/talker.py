"""A node that says its name on a topic ten times a second until it is ended: talker.py <name>."""

import sys

import octn_ros.embedded

octn_ros.embedded.install()

import rclpy  # noqa: E402
from nav_msgs.msg import Path  # noqa: E402
from rclpy.executors import ExternalShutdownException  # noqa: E402
from rclpy.node import Node  # noqa: E402

rclpy.init(args=[])
node = Node(f"talker_{sys.argv[1]}")
publisher = node.create_publisher(Path, "spoken", 10)
message = Path()
message.header.frame_id = sys.argv[1]
node.create_timer(0.1, lambda: publisher.publish(message))
print("talking", flush=True)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
finally:
    node.destroy_node()
    rclpy.try_shutdown()
