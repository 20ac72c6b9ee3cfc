"""The simulator node: an OCT scanner, an arm and a laser on one piece of tissue."""

from __future__ import annotations

import sys
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

from octn_ros.errors import OctnError
from octn_ros.nodes import conversions, process, qos, status
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.planning import from_translation_quaternion, load_calibration
from octn_ros.resources import config_path
from octn_ros.settings import check_settings, setting
from octn_ros.simulation import Arm, ArmConfig, BScan, LaserPath, PhantomConfig, Scanner, make_phantom
from octn_ros.volume import OCT_FRAME, Volume, load_volume

BSCAN_FRAME = "oct_bscan_frame"
SHORTEST_TIMER_S = 1e-3
STATUS_PERIOD_NS = 500_000_000  # between reports of a running execution
SAME_PLACE_M = 1e-6  # float32 of the tool path against float64 of the waypoints, at a metre from the flange


@dataclass(frozen=True)
class SimulatorConfig:
    """What is simulated."""

    volume_file: str = setting("", "C-scan (NIfTI) that the scanner plays; empty = the phantom of phantom.*")
    spacing_um: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "voxel spacing (bscan, axial, lateral) of volume_file in place of its own; 0 = as the file states",
        unit="um",
        low=0.0,
    )
    calibration: str = setting("", "calibration file (YAML); empty = the package's config/calibration.yaml")
    bscan_period_s: float = setting(0.002, "time from one B-scan to the next", unit="s", low=1e-6, high=10.0)
    ee_pose_rate_hz: float = setting(50.0, "how often ee_pose is published", unit="Hz", low=0.1, high=1000.0)
    arm_position_m: tuple[float, float, float] = setting(
        (0.42, 0.08, 0.30), "where the end effector stands at the start, in the base frame", unit="m"
    )
    arm_orientation: tuple[float, float, float, float] = setting(
        (1.0, 0.0, 0.0, 0.0), "how it is turned there, quaternion (x, y, z, w); the default points down"
    )
    time_factor: float = setting(1.0, "seconds of the arm's time per second of the clock", low=0.01, high=1e4)

    def __post_init__(self) -> None:
        check_settings(self)


class Simulator(Node):
    """Plays a C-scan when asked to, stages what the planner publishes, and runs it only on `execute`.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("simulator", namespace=namespace, **options)
        fixed = ("volume_file", "spacing_um", "calibration", "ee_pose_rate_hz", "arm_position_m", "arm_orientation")
        self._config = ConfigParameters(self, SimulatorConfig(), read_only=fixed)
        phantom = ConfigParameters(self, PhantomConfig(), "phantom", read_only=True).config()
        arm = ConfigParameters(self, ArmConfig(), "arm", read_only=True).config()
        config = self._config.config()
        self._calibration = load_calibration(config.calibration or config_path("calibration.yaml"))
        volume = _tissue(config, phantom)
        self._scanner = Scanner(volume)
        pose = from_translation_quaternion(config.arm_position_m, config.arm_orientation)
        self._lock = threading.RLock()  # over the arm, what is known of its plan, and the order of the reports
        self._arm = Arm(arm, self._calibration.laser2ee, pose, self._calibration.ee_frame)
        self._scan_stamp_ns, self._scan_pose = 0, pose
        self._unsent: deque[BScan] = deque()
        self._waypoints: PoseArray | None = None
        self._tool_path: PointCloud2 | None = None
        self._no_plan = "none has been received"  # why nothing is staged
        self._stepped_ns = self._reported_ns = 0

        profile = qos.scan_profile(volume.geometry.shape[0])
        self._bscan = self.create_publisher(Image, "bscan", profile)
        self._bscan_pose = self.create_publisher(PoseStamped, "bscan_pose", profile)
        self._ee_pose = self.create_publisher(PoseStamped, "ee_pose", qos.STREAM)
        self._status = status.StatusTopic(self, "execution_status", qos.LATCHED)
        self.create_subscription(PoseArray, "waypoints", self._on_waypoints, qos.LATCHED)
        self.create_subscription(PointCloud2, "tool_path", self._on_tool_path, qos.LATCHED)
        self.create_service(Trigger, "scan", self._scan)
        # Commands have a group of their own, so that nothing slow holds an abort up.
        commands, motion = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self.create_service(Trigger, "execute", self._execute, callback_group=commands)
        self.create_service(Trigger, "abort", self._abort, callback_group=commands)
        self.create_timer(1.0 / config.ee_pose_rate_hz, self._publish_ee_pose, callback_group=motion)
        # The control period costs a fifth of a core, so its timer runs during an execution only.
        self._step_timer = self.create_timer(arm.control_period_s, self._step, callback_group=motion)
        self._step_timer.cancel()
        self._send_timer = self.create_timer(max(config.bscan_period_s, SHORTEST_TIMER_S), self._send_bscans)
        self._send_timer.cancel()
        shape = " x ".join(str(n) for n in volume.geometry.shape)
        self._report(status.OK, f"ready: {config.volume_file or phantom.name}, {shape} voxels")

    # --- scanner

    def _scan(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        config = self._config.config()
        with self._lock:
            if self._unsent:
                response.message = f"scan refused: a scan is running, {len(self._unsent)} B-scans are still to come"
            elif self._arm.state == "executing":
                response.message = "scan refused: the arm is executing a plan; wait, or abort it"
            elif not self._bscan.get_subscription_count() or not self._bscan_pose.get_subscription_count():
                response.message = "scan refused: nobody listens to bscan and bscan_pose; start the trainer"
            else:
                start_ns = self.get_clock().now().nanoseconds
                bscans = self._scanner.bscans(start_ns, round(config.bscan_period_s * 1e9))
                self._scan_stamp_ns, self._scan_pose = start_ns, self._arm.ee2base
                if self._arm.state == "staged":
                    self._no_plan = "a new scan has withdrawn the plan before it"
                self._arm.new_scan()
                self._unsent.extend(bscans)
                response.success = True
                response.message = f"scanning {len(self._unsent)} B-scans"
        if response.success:
            self._publish_ee_pose()  # one more pose near the scan's stamp, however seldom they are published
            self._send_timer.reset()
        self._report(status.OK if response.success else status.WARN, response.message)
        return response

    def _send_bscans(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        while self._unsent and self._unsent[0].stamp_ns <= now_ns:
            bscan = self._unsent.popleft()
            pose = conversions.matrix_to_pose_stamped(bscan.image2oct, bscan.stamp_ns, OCT_FRAME)
            self._bscan_pose.publish(pose)
            self._bscan.publish(conversions.to_image(bscan.image, bscan.stamp_ns, BSCAN_FRAME))
        if not self._unsent:
            self._send_timer.cancel()

    # --- plans

    def _on_waypoints(self, message: PoseArray) -> None:
        self._waypoints = message
        self._stage()

    def _on_tool_path(self, message: PointCloud2) -> None:
        self._tool_path = message
        self._stage()

    def _stage(self) -> None:
        """Stage the plan once both of its messages are here; two plans of one scan have equal stamps."""
        waypoints, tool_path = self._waypoints, self._tool_path
        if waypoints is None or tool_path is None or waypoints.header.stamp != tool_path.header.stamp:
            return
        stamp_ns = conversions.stamp_to_ns(waypoints.header.stamp)
        try:
            poses, rows = conversions.poses_to_matrices(waypoints.poses), conversions.cloud_to_tool_path(tool_path)
            places = np.stack([rows["x"], rows["y"], rows["z"]], axis=-1)
            if len(rows) != len(poses) or np.any(np.abs(places - poses[:, :3, 3]) > SAME_PLACE_M):
                return  # one of the two belongs to another plan; its partner is still to come
            if not len(poses):
                self._withdraw()
                return
            path = LaserPath(
                poses,
                rows["segment"].astype(np.int32),
                rows["laser_on"].astype(bool),
                rows["speed"].astype(np.float64),
                stamp_ns,
                waypoints.header.frame_id,
            )
            with self._lock:
                try:
                    self._arm.stage(path, self._scan_stamp_ns, self._scan_pose)
                except OctnError as error:
                    self._no_plan = f"the last one was refused: {error}"
                    raise
        except OctnError as error:
            self._report(status.ERROR, f"plan refused: {error}")
            return
        self._report(status.OK, f"plan of {len(path)} waypoints staged")

    def _withdraw(self) -> None:
        with self._lock:
            staged = self._arm.state == "staged"
            self._arm.withdraw()
            self._no_plan = "the planner has withdrawn the last one"
        if staged:
            self._report(status.WARN, "the planner has withdrawn the plan")

    # --- execution

    def _execute(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        now_ns = self.get_clock().now().nanoseconds
        with self._lock:
            try:
                self._arm.execute(now_ns)
            except OctnError as error:
                why = "" if self._arm.state in ("staged", "executing") else f"; {self._no_plan}"
                response.message = f"execute refused: {error}{why}"
                self._report(status.ERROR, response.message)
                return response
            self._stepped_ns = self._reported_ns = now_ns
            self._step_timer.reset()
            response.success = True
            response.message = f"executing {self._arm.progress[1]} waypoints"
            self._report(status.OK, response.message)
        return response

    def _abort(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            state = self._arm.state
            self._arm.abort()
            if state in ("staged", "executing"):
                self._no_plan = "the last one was aborted"
            response.success = True
            response.message = {
                "executing": f"aborted after {self._arm.executed} shots",
                "staged": "the staged plan is dropped; nothing was executing",
            }.get(state, "nothing was executing")
            self._report(status.WARN, response.message)
        return response

    def _step(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        factor = self._config.config().time_factor if self._arm.state == "executing" else 1.0
        with self._lock:
            if self._arm.state != "executing":
                self._step_timer.cancel()
                return
            self._arm.step(max(now_ns - self._stepped_ns, 0) * 1e-9 * factor)
            self._stepped_ns = now_ns
            if self._arm.state == "done":
                self._no_plan = "the last one has been executed"
                self._report(status.OK, f"done: {self._arm.executed} shots")
            elif now_ns - self._reported_ns >= STATUS_PERIOD_NS:
                self._reported_ns = now_ns
                self._report(status.OK, "executing", log=False)

    def _publish_ee_pose(self) -> None:
        with self._lock:
            pose = self._arm.ee2base
        now_ns = self.get_clock().now().nanoseconds
        self._ee_pose.publish(conversions.matrix_to_pose_stamped(pose, now_ns, self._calibration.base_frame))

    def _report(self, level: bytes, message: str, *, log: bool = True) -> None:
        with self._lock:
            passed, count = self._arm.progress
            values = {
                "state": self._arm.state,
                "scan_stamp_ns": self._scan_stamp_ns,
                "waypoints": count,
                "passed": passed,
                "shots": self._arm.executed,
                "laser_on": self._arm.laser_on,
            }
            self._status.report(level, message, values, log=log)


def _tissue(config: SimulatorConfig, phantom: PhantomConfig) -> Volume:
    if not config.volume_file:
        return make_phantom(phantom).volume
    return load_volume(config.volume_file, config.spacing_um if all(config.spacing_um) else None)


def main(args: list[str] | None = None) -> int:
    """Run the simulator as a process."""
    return process.run(Simulator, args)


if __name__ == "__main__":
    sys.exit(main())
