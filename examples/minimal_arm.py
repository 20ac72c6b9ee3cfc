"""What a robot arm must do for trainer and planner, in one node: say where it is, take plans, and wait for a word.

Put your robot's driver in place of `_read_pose` and `_go`. Usage: python examples/minimal_arm.py
"""

import sys

import numpy as np

import octn_ros.nodes  # noqa: F401 - makes rclpy and the message packages importable where ROS 2 is missing

# isort: split
import rclpy
from geometry_msgs.msg import Pose, PoseArray, PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from octn_ros.nodes.conversions import cloud_to_tool_path, matrix_to_pose_stamped, pose_to_matrix
from octn_ros.planning import invert, load_calibration
from octn_ros.resources import config_path

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # as the planner publishes its plans
POSE_PERIOD_S = 0.02


class MinimalArm(Node):
    """Publishes `ee_pose`, stages what the planner publishes, and goes there only on `execute`."""

    def __init__(self) -> None:
        super().__init__("arm", namespace="octn")
        self.declare_parameter("calibration", str(config_path("calibration.yaml")))
        self._calibration = load_calibration(self.get_parameter("calibration").value)
        self._ee2base = pose_to_matrix(Pose())
        self._ee2base[:3, 3] = 0.4, 0.0, 0.3
        self._waypoints, self._tool_path = PoseArray(), PointCloud2()
        self.reached: list[np.ndarray] = []  # where the laser's focus has been, in the base
        self._ee_pose = self.create_publisher(PoseStamped, "ee_pose", 50)
        self.create_subscription(PoseArray, "waypoints_base", self._on_waypoints, LATCHED)
        self.create_subscription(PointCloud2, "tool_path", self._on_tool_path, LATCHED)
        self.create_service(Trigger, "execute", self._execute)
        # In a group of its own: the pose goes on being told while the arm moves.
        self.create_timer(POSE_PERIOD_S, self._tell_pose, callback_group=MutuallyExclusiveCallbackGroup())

    def _read_pose(self) -> np.ndarray:
        return self._ee2base  # yours: forward kinematics, at the time of the stamp below

    def _tell_pose(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        self._ee_pose.publish(matrix_to_pose_stamped(self._read_pose(), now_ns, self._calibration.base_frame))

    def _on_waypoints(self, message: PoseArray) -> None:
        self._waypoints = message  # nothing moves yet; an empty one withdraws the plan

    def _on_tool_path(self, message: PointCloud2) -> None:
        self._tool_path = message

    def _execute(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        poses, path = self._waypoints, self._tool_path
        if not poses.poses:
            response.message = "there is no plan"
        elif poses.header.stamp != path.header.stamp or len(poses.poses) != path.width:
            response.message = "waypoints and tool path are of different plans; ask again"
        else:
            for pose, row in zip(poses.poses, cloud_to_tool_path(path), strict=True):
                self._go(pose_to_matrix(pose), float(row["speed"]), bool(row["laser_on"]))
            response.success, response.message = True, f"{len(poses.poses)} waypoints reached"
        return response

    def _go(self, focus2base: np.ndarray, speed_m_s: float, laser_on: bool) -> None:
        """Bring the laser's focus to a pose: the flange goes where the calibration puts it."""
        self._ee2base = focus2base @ invert(self._calibration.laser2ee)  # yours: command the robot, wait until there
        self.reached.append((self._ee2base @ self._calibration.laser2ee)[:3, 3])


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init(args=sys.argv)
    node = MinimalArm()
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
