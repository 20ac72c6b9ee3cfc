"""A node written for rclpy of Jazzy: latched path, service, parameter, timer. Says `ready` from its first timer."""

import sys

import octn_ros.embedded

octn_ros.embedded.install()

import rclpy  # noqa: E402
from geometry_msgs.msg import PoseStamped  # noqa: E402
from nav_msgs.msg import Path  # noqa: E402
from nav_msgs.srv import GetPlan  # noqa: E402
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor  # noqa: E402
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402


class Server(Node):
    def __init__(self):
        super().__init__("server")
        limits = FloatingPointRange(from_value=0.0, to_value=5.0)
        self.declare_parameter("gain", 1.0, ParameterDescriptor(floating_point_range=[limits]))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.path = self.create_publisher(Path, "path", latched)
        for count in (1, 3):
            self.path.publish(Path(poses=[PoseStamped()] * count))
        self.create_service(GetPlan, "plan", self.plan)
        self.said = self.create_timer(0.01, self.say)

    def say(self):
        self.said.cancel()
        print("ready", flush=True)

    def plan(self, request, response):
        response.plan.header.frame_id = request.start.header.frame_id + "!"
        response.plan.poses = [PoseStamped() for _ in range(1000)]
        return response


def main():
    rclpy.init()
    node = Server()
    executor = MultiThreadedExecutor(2) if "threads" in sys.argv else SingleThreadedExecutor()
    try:
        rclpy.spin(node, executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


main()
