"""A node that waits for others, says that it saw them, and stays until it is ended: peer.py <name> <other>..."""

import sys

import octn_ros.embedded

octn_ros.embedded.install()

import rclpy  # noqa: E402
from rclpy.executors import ExternalShutdownException  # noqa: E402
from rclpy.node import Node  # noqa: E402

WAIT_SEC = 120.0

rclpy.init(args=[])
node = Node(sys.argv[1])
missing = [other for other in sys.argv[2:] if not node.wait_for_node(f"/{other}", WAIT_SEC)]
print("missing " + " ".join(missing) if missing else "met", flush=True)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
finally:
    node.destroy_node()
    rclpy.try_shutdown()
