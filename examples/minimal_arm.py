"""What a robot arm must do for trainer and planner, in one node: say where it is, take plans, and wait for a word.

Put your robot's driver in place of `_read_pose` and `_go`. Usage: python examples/minimal_arm.py
"""

import sys

import numpy as np

import octn_ros.nodes  # noqa: F401 - makes rclpy and the message packages importable where ROS 2 is missing

# isort: split
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Pose, PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger

from octn_ros.nodes import process, status
from octn_ros.nodes.conversions import cloud_to_tool_path, matrix_to_pose_stamped, plan_hash, pose_to_matrix
from octn_ros.nodes.qos import LATCHED
from octn_ros.planning import from_translation_quaternion, invert, load_calibration
from octn_ros.resources import config_path

POSE_PERIOD_S = 0.02


class MinimalArm(Node):
    """Publishes `ee_pose`, stages what the planner publishes, and goes there only on `execute`, the laser enabled."""

    def __init__(self) -> None:
        super().__init__("arm", namespace="octn")
        self.declare_parameter("calibration", str(config_path("calibration.yaml")))
        self._calibration = load_calibration(self.get_parameter("calibration").value)
        self._ee2base = pose_to_matrix(Pose())
        self._ee2base[:3, 3] = 0.4, 0.0, 0.3
        # Two plans of one scan have equal stamps, so all of a plan is taken from one message.
        self._tool_path, self._scan_pose = PointCloud2(), PoseStamped()
        self._plan_hash = self._stands = ""  # of that tool path, and of the plan that the planner stands for
        self._laser_enabled = False
        self.reached: list[np.ndarray] = []  # where the laser's focus has been, in the base
        self._ee_pose = self.create_publisher(PoseStamped, "ee_pose", 50)
        self._status = status.StatusTopic(self, "execution_status", LATCHED)  # goes to the log too
        # In a group of their own: while the arm moves its pose is told, and who takes back plan or laser is heard.
        aside = MutuallyExclusiveCallbackGroup()
        self.create_timer(POSE_PERIOD_S, self._tell_pose, callback_group=aside)
        self.create_subscription(PoseStamped, "scan_ee_pose", self._on_scan_pose, LATCHED, callback_group=aside)
        self.create_subscription(PointCloud2, "tool_path", self._on_tool_path, LATCHED, callback_group=aside)
        self.create_subscription(DiagnosticArray, "plan_status", self._on_plan_status, LATCHED, callback_group=aside)
        self.create_service(SetBool, "enable_laser", self._enable_laser, callback_group=aside)
        self.create_service(Trigger, "execute", self._execute)
        self._say("idle", "ready: no plan, the laser is disabled")

    def _say(self, state: str, words: str) -> None:
        self._status.report(status.OK if state != "aborted" else status.ERROR, words, {"state": state})

    def _read_pose(self) -> np.ndarray:
        return self._ee2base  # yours: forward kinematics, at the time of the stamp below

    def _tell_pose(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        self._ee_pose.publish(matrix_to_pose_stamped(self._read_pose(), now_ns, self._calibration.base_frame))

    def _on_scan_pose(self, message: PoseStamped) -> None:
        self._scan_pose = message
        self._look_at_plan()

    def _on_tool_path(self, message: PointCloud2) -> None:
        self._tool_path, self._plan_hash = message, plan_hash(message)
        self._look_at_plan()

    def _on_plan_status(self, message: DiagnosticArray) -> None:
        stood, self._stands = self._stands, status.read(message)[2].get("plan_hash", "")
        if self._stands != stood:
            self._look_at_plan()

    def _look_at_plan(self) -> None:
        """Nothing moves yet; an empty tool path withdraws the plan, and stops an arm that follows it."""
        why_not = self._why_not(self._tool_path)
        self._say(*(("idle", why_not) if why_not else ("staged", f"plan of {self._tool_path.width} waypoints staged")))

    def _why_not(self, path: PointCloud2) -> str:
        if not path.width:
            return "there is no plan"
        if path.header.stamp != self._scan_pose.header.stamp:
            return "the plan is of another scan than the newest; plan again"
        if path is not self._tool_path or self._plan_hash != self._stands:
            return "the planner does not stand for the plan (plan_hash in plan_status); plan again"
        return ""

    def _enable_laser(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._laser_enabled = bool(request.data)
        response.success, response.message = True, f"the laser is {'enabled' if request.data else 'disabled'}"
        self.get_logger().info(response.message)
        return response

    def _execute(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        path, scan_pose = self._tool_path, self._scan_pose
        response.message = self._why_not(path)
        if not response.message and not self._laser_enabled:
            response.message = "the laser is disabled; call enable_laser"
        if not response.message:
            response.success, response.message = self._follow(path, pose_to_matrix(scan_pose.pose))
        return response

    def _follow(self, path: PointCloud2, scan_ee2base: np.ndarray) -> tuple[bool, str]:
        self._say("executing", f"executing {path.width} waypoints")
        for done, row in enumerate(cloud_to_tool_path(path)):
            if self._why_not(path) or not self._laser_enabled:
                words = f"aborted after {done} waypoints: plan or laser was taken back"
                self._say("aborted", words)
                return False, words
            place, turn = [row[name] for name in ("x", "y", "z")], [row[name] for name in ("qx", "qy", "qz", "qw")]
            focus2ee = from_translation_quaternion(place, turn)  # of the end effector at the time of the scan
            self._go(scan_ee2base @ focus2ee, float(row["speed"]), bool(row["laser_on"]))
        words = f"{path.width} waypoints reached"
        self._say("done", words)
        return True, words

    def _go(self, focus2base: np.ndarray, speed_m_s: float, laser_on: bool) -> None:
        """Bring the laser's focus to a pose: the flange goes where the calibration puts it."""
        self._ee2base = focus2base @ invert(self._calibration.laser2ee)  # yours: command the robot, wait until there
        self.reached.append((self._ee2base @ self._calibration.laser2ee)[:3, 3])


if __name__ == "__main__":
    # Until Ctrl-C, on an executor with threads: while `execute` runs, all else is heard.
    sys.exit(process.run(MinimalArm))
