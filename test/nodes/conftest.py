"""A trainer with a client that plays the scanner and the arm, a simulator with one that plays all others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import LoadMap
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.simulator import Simulator
from octn_ros.nodes.trainer import Trainer
from octn_ros.planning import load_calibration
from octn_ros.resources import config_path
from octn_ros.simulation import BScan, PhantomConfig, Scanner, make_phantom
from octn_ros.volume import Volume

TIMEOUT_S = 120.0  # of what hangs: kernels may have to be compiled first, beside other work
SHAPE = (6, 24, 16)
SPACING_UM = [28.0, 14.59, 14.0]
FIT = {
    "fit__steps": 5,
    "fit__batch": 256,
    "fit__time_budget_s": 0.0,
    "fit__field__grid__log2_table_size": 10,
    "device": "cpu",
}
BASE = "base_link"
SMALL_PHANTOM = (5, 24, 16)
ON_TIME = {"time_factor": 1.0, "phantom__shape": [40, 64, 80], "bscan_period_s": 1e-4}


@pytest.fixture(scope="module")
def volume() -> Volume:
    """A C-scan of few voxels."""
    return make_phantom(
        PhantomConfig(shape=SHAPE, spacing_m=tuple(s * 1e-6 for s in SPACING_UM), surface="flat")
    ).volume


class TrainerBench:
    """The trainer and a client that plays the scanner."""

    timeout_s = TIMEOUT_S

    def __init__(self, spin: Callable[..., Any], client: Any, **parameters: Any) -> None:
        self.client = client
        self.progress = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
        self.field = client.watch(CompressedImage, "field")
        self.enface = client.watch(OccupancyGrid, "enface")
        self.scan_ee_pose = client.watch(PoseStamped, "scan_ee_pose")
        profile = qos.scan_profile(SHAPE[0])
        self.bscan = client.node.create_publisher(Image, "bscan", profile)
        self.bscan_pose = client.node.create_publisher(PoseStamped, "bscan_pose", profile)
        self.ee_pose = client.node.create_publisher(PoseStamped, "ee_pose", qos.STREAM)
        self.node = spin(Trainer, **(FIT | parameters))
        self.progress.wait_matched(TIMEOUT_S)
        for publisher in (self.bscan, self.bscan_pose, self.ee_pose):
            client.wait_for(lambda publisher=publisher: publisher.get_subscription_count() > 0, TIMEOUT_S, "trainer")

    def load(self, url: str) -> Any:
        """Call load_cscan."""
        return self.client.call(LoadMap, "load_cscan", LoadMap.Request(map_url=url), TIMEOUT_S)

    def scan(self, volume: Volume, start_ns: int, *, skip: int = -1, frame: str = "oct_optical_frame") -> None:
        """Play a C-scan, of which one B-scan may be left out."""
        for bscan in Scanner(volume).bscans(start_ns, 1_000_000):
            if bscan.index != skip:
                self.send(bscan, frame=frame)

    def send(self, bscan: BScan, *, frame: str = "oct_optical_frame", image_frame: str = "oct_bscan_frame") -> None:
        """Publish one B-scan and its pose."""
        self.bscan.publish(conversions.to_image(bscan.image, bscan.stamp_ns, image_frame))
        self.bscan_pose.publish(conversions.matrix_to_pose_stamped(bscan.image2oct, bscan.stamp_ns, frame))

    def set(self, name: str, value: Any) -> Any:
        """Set one parameter of the trainer and return the result."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.client.call(SetParameters, "trainer/set_parameters", request, TIMEOUT_S).results[0]

    def trigger(self, name: str) -> Any:
        """Call refit or cancel."""
        return self.client.call(Trigger, name, Trigger.Request(), TIMEOUT_S)

    def values(self, state: str) -> dict[str, str]:
        """Return the values of the first report of that state on fit_progress, heard already or still to come."""
        return status.read(
            self.progress.wait(TIMEOUT_S, lambda message: status.read(message)[2].get("state") == state)
        )[2]

    def pose_told(self, stamp_ns: int) -> Any:
        """Return the latest pose of the scan as it is published."""
        self.scan_ee_pose.wait(TIMEOUT_S)
        message = self.scan_ee_pose.messages[-1]
        assert message.header == conversions.header(stamp_ns, BASE)
        return conversions.pose_to_matrix(message.pose)

    def until(self, *words: str) -> Any:
        """Return the first report on fit_progress with all of these words."""
        return self.progress.wait(TIMEOUT_S, lambda message: all(word in status.read(message)[1] for word in words))


@pytest.fixture
def trainer_bench(spin: Callable[..., Any], client: Any, tmp_path: Path) -> Callable[..., TrainerBench]:
    """Make a trainer, with parameters, and what a test needs around it; it may read below the test's folder."""
    return lambda **parameters: TrainerBench(spin, client, **({"data_root": str(tmp_path)} | parameters))


class SimulatorBench:
    """The simulator with a record, and a client at all of its topics that plays trainer, planner and surgeon."""

    timeout_s = TIMEOUT_S
    SLOW_M_S = 1e-4  # a line takes ten seconds, of two hundred waypoints 50 ms from each to the next

    def __init__(
        self,
        spin: Callable[..., Any],
        client: Any,
        planner: Any,
        folder: Path,
        *,
        on_time: bool = False,
        **parameters: Any,
    ) -> None:
        self.client, self.planner, self.audit_path = client, planner, folder / "audit.jsonl"
        profile = qos.scan_profile(SHAPE[0])
        self.bscan = client.watch(Image, "bscan", profile)
        self.bscan_pose = client.watch(PoseStamped, "bscan_pose", profile)
        self.ee_pose = client.watch(PoseStamped, "ee_pose", qos.STREAM)
        self.status = client.watch(DiagnosticArray, "execution_status", qos.REPORTS)
        self.laser_on = client.watch(Bool, "laser_on")
        self.removed = client.watch(Image, "removed_depth")
        given = {
            "phantom__shape": list(SMALL_PHANTOM),
            "phantom__surface": "flat",
            "time_factor": 100.0,
            "audit_path": str(self.audit_path),
            "interlock__longest_stall_s": 3.0,  # beside other work on the machine
        }
        given |= (ON_TIME if on_time else {}) | parameters
        self.node = spin(Simulator, **given)
        self.bscans = given["phantom__shape"][0]
        for watch in (self.bscan, self.bscan_pose, self.ee_pose, self.status):
            watch.wait_matched(TIMEOUT_S)

    def call(self, name: str) -> Any:
        """Call a Trigger service."""
        return self.client.call(Trigger, name, Trigger.Request(), TIMEOUT_S)

    def enable(self, on: bool = True) -> Any:
        """Call enable_laser."""
        return self.client.call(SetBool, "enable_laser", SetBool.Request(data=on), TIMEOUT_S)

    def set(self, name: str, value: Any) -> Any:
        """Set one parameter of the simulator and return the result."""
        asked = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.client.call(SetParameters, "simulator/set_parameters", asked, TIMEOUT_S).results[0]

    def scan(self, bscans: int = 0) -> int:
        """Scan once the simulator has met both subscriptions; return the stamp of B-scan 0."""
        before, count = len(self.bscan.messages), bscans or self.bscans
        self.client.wait_for(lambda: self.call("scan").success, TIMEOUT_S, "scan")
        self.bscan.wait(TIMEOUT_S, lambda message: len(self.bscan.messages) >= before + count)
        return conversions.stamp_to_ns(self.bscan.messages[before].header.stamp)

    def until(self, *words: str, after: int = 0) -> dict[str, str]:
        """Return the values of the first report on execution_status with all of these words."""

        def fits(message: Any) -> bool:
            return all(word in status.read(message)[1] for word in words)

        return status.read(self.status.wait(TIMEOUT_S, fits, after=after))[2]

    @staticmethod
    def line(count: int = 200) -> Any:
        """Return waypoints over a millimetre of the larger phantom's surface."""
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, 0, 3] = np.linspace(0.05e-3, 1.05e-3, count)
        poses[:, 1, 3], poses[:, 2, 3] = 0.5e-3, 0.25 * 63 * 14.59e-6
        return load_calibration(config_path("calibration.yaml")).oct2ee @ poses

    def staged(self) -> int:
        """Scan, plan a line and enable the laser; return the stamp of the scan."""
        stamp_ns, told = self.scan(), len(self.status.messages)
        self.planner.plan(stamp_ns, self.line(), speed_m_s=self.SLOW_M_S)
        self.until("staged", after=told)
        assert self.enable().success
        return stamp_ns

    def begin(self) -> int:
        """The same, and execute."""
        stamp_ns = self.staged()
        answer = self.call("execute")
        assert answer.success, answer.message
        return stamp_ns

    def executing(self) -> int:
        """The same, until the laser is on."""
        lit = len(self.laser_on.messages)
        stamp_ns = self.begin()
        self.laser_on.wait(TIMEOUT_S, lambda message: message.data, after=lit)
        return stamp_ns

    def ended(self, *words: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """Wait for an aborted execution; return the end of its record and its shots."""
        values = self.until("aborted", *words)
        assert (values["state"], values["laser_on"], values["laser_enabled"]) == ("aborted", "false", "false")
        self.client.wait_for(lambda: self.laser_on.messages[-1].data is False, TIMEOUT_S, "laser_on: false")
        (end,) = self.audit("end")
        assert end["outcome"] == "aborted"
        return end, self.audit("shot")

    def audit(self, event: str) -> list[dict[str, Any]]:
        """Return the lines of one kind of the record."""
        if not self.audit_path.exists():
            return []
        lines = (json.loads(text) for text in self.audit_path.read_text(encoding="utf-8").splitlines())
        return [found for found in lines if found["event"] == event]


@pytest.fixture
def simulator_bench(
    spin: Callable[..., Any], client: Any, planner_stand_in: Callable[[], Any], tmp_path: Path
) -> Callable[..., SimulatorBench]:
    """Make a simulator, with parameters, and what a test needs around it; `on_time`, with a phantom to be cut."""
    return lambda **parameters: SimulatorBench(spin, client, planner_stand_in(), tmp_path, **parameters)
