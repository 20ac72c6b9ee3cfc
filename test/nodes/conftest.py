"""A trainer with a client that plays the scanner and the arm, and a small C-scan for it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import LoadMap
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger

from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.trainer import Trainer
from octn_ros.simulation import BScan, PhantomConfig, Scanner, make_phantom
from octn_ros.volume import Volume

TIMEOUT_S = 30.0
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
