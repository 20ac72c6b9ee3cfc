"""The simulator alone: the client plays trainer and planner, and asks for what cannot be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import SetBool, Trigger

from octn_ros.errors import ConfigurationError
from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.simulator import Simulator
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import save_volume

TIMEOUT_S = 30.0
SHAPE = (5, 24, 16)


class Bench:
    """The simulator and a client at all of its topics."""

    def __init__(self, spin: Callable[..., Any], client: Any, **parameters: Any) -> None:
        self.client = client
        profile = qos.scan_profile(SHAPE[0])
        self.bscan = client.watch(Image, "bscan", profile)
        self.bscan_pose = client.watch(PoseStamped, "bscan_pose", profile)
        self.ee_pose = client.watch(PoseStamped, "ee_pose", qos.STREAM)
        self.status = client.watch(DiagnosticArray, "execution_status")
        self.waypoints = client.node.create_publisher(PoseArray, "waypoints", qos.LATCHED)
        self.tool_path = client.node.create_publisher(PointCloud2, "tool_path", qos.LATCHED)
        spin(
            Simulator,
            **{"phantom__shape": list(SHAPE), "phantom__surface": "flat", "time_factor": 100.0, **parameters},
        )
        for watch in (self.bscan, self.bscan_pose, self.ee_pose, self.status):
            watch.wait_matched(TIMEOUT_S)

    def call(self, name: str) -> Any:
        return self.client.call(Trigger, name, Trigger.Request(), TIMEOUT_S)

    def enable(self, on: bool = True) -> Any:
        return self.client.call(SetBool, "enable_laser", SetBool.Request(data=on), TIMEOUT_S)

    def scan(self) -> int:
        """Scan once the simulator has met both subscriptions; return the stamp of B-scan 0."""
        before = len(self.bscan.messages)
        self.client.wait_for(lambda: self.call("scan").success, TIMEOUT_S, "scan")
        self.bscan.wait(TIMEOUT_S, lambda message: len(self.bscan.messages) >= before + SHAPE[0])
        return conversions.stamp_to_ns(self.bscan.messages[before].header.stamp)

    def publish(self, stamp_ns: int, poses: np.ndarray, *, frame: str = "tool0", path_stamp_ns: int = 0) -> None:
        count = len(poses)
        on, speed = np.ones(count), np.full(count, 0.01)
        rows = conversions.tool_path(poses, np.zeros(count), on, speed, np.zeros(count), on)
        self.tool_path.publish(conversions.to_cloud(rows, path_stamp_ns or stamp_ns, frame))
        self.waypoints.publish(conversions.to_pose_array(poses, stamp_ns, frame))

    def until(self, *words: str) -> dict[str, str]:
        message = self.status.wait(TIMEOUT_S, lambda message: all(word in status.read(message)[1] for word in words))
        return status.read(message)[2]


def line(count: int = 5) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = np.linspace(0.0, 1e-3, count), 0.1
    return poses


def test_a_scan_is_played_as_stamped_images_with_their_poses(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client)
    bench.scan()
    bench.bscan_pose.wait(TIMEOUT_S, lambda message: len(bench.bscan_pose.messages) >= SHAPE[0])
    volume = make_phantom(PhantomConfig(shape=SHAPE, surface="flat")).volume
    for index, (image, pose) in enumerate(zip(bench.bscan.messages, bench.bscan_pose.messages, strict=True)):
        assert image.header.stamp == pose.header.stamp
        assert (image.header.frame_id, pose.header.frame_id) == ("oct_bscan_frame", "oct_optical_frame")
        np.testing.assert_array_equal(conversions.image_to_array(image), volume.array[index])
        assert pose.pose.position.y == pytest.approx(index * 28e-6)
    assert bench.ee_pose.wait(TIMEOUT_S).header.frame_id == "base_link"


def test_a_scan_that_nobody_would_hear_is_refused(spin: Callable[..., Any], client: Any) -> None:
    spin(Simulator, phantom__shape=list(SHAPE))
    answer = client.call(Trigger, "scan", Trigger.Request(), TIMEOUT_S)
    assert not answer.success
    assert "nobody listens" in answer.message


def test_a_plan_is_staged_on_receipt_and_runs_only_on_execute(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client)
    bench.publish(bench.scan(), line())
    assert bench.until("5 waypoints staged")["shots"] == "0"
    refused = bench.call("execute")
    assert not refused.success
    assert "enable_laser" in refused.message
    assert bench.enable().success
    answer = bench.call("execute")
    assert answer.success, answer.message
    assert bench.until("done")["shots"] == "5"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stamp_offset_ns": 1}, "another scan"),
        ({"frame": "oct_optical_frame"}, "'tool0'"),
        ({"poses": line() + 2.0 * np.eye(4, k=3)}, "reach"),
    ],
)
def test_a_plan_that_cannot_run_is_refused(
    spin: Callable[..., Any], client: Any, changes: dict[str, Any], reason: str
) -> None:
    bench = Bench(spin, client)
    stamp_ns = bench.scan() + changes.get("stamp_offset_ns", 0)
    bench.publish(stamp_ns, changes.get("poses", line()), frame=changes.get("frame", "tool0"))
    bench.until("plan refused", reason)
    answer = bench.call("execute")
    assert not answer.success
    assert reason in answer.message


def test_waypoints_without_their_tool_path_are_not_staged(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client)
    stamp_ns = bench.scan()
    bench.publish(stamp_ns, line(), path_stamp_ns=stamp_ns + 1)
    assert not bench.call("execute").success
    bench.publish(stamp_ns, line(7))
    bench.until("7 waypoints staged")


def test_an_empty_plan_withdraws_the_staged_one(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client)
    stamp_ns = bench.scan()
    bench.publish(stamp_ns, line())
    bench.until("staged")
    bench.publish(stamp_ns, line(0))
    bench.until("withdrawn")
    answer = bench.call("execute")
    assert not answer.success
    assert "withdrawn" in answer.message


def test_an_abort_ends_the_execution_and_the_plan(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, time_factor=0.01)
    assert "nothing" in bench.call("abort").message
    bench.publish(bench.scan(), line())
    bench.until("staged")
    assert bench.enable().success
    assert bench.call("execute").success
    refused = bench.call("scan")
    assert not refused.success
    assert "executing" in refused.message
    assert bench.call("abort").message == "aborted after 0 shots; the laser is disabled"
    assert bench.until("aborted")["state"] == "aborted"
    again = bench.call("execute")
    assert not again.success
    assert "an abort was asked for" in again.message


def test_a_recorded_volume_is_played_with_the_spacing_given(
    spin: Callable[..., Any], client: Any, tmp_path: Any
) -> None:
    volume = make_phantom(PhantomConfig(shape=SHAPE, surface="flat", seed=5)).volume
    save_volume(tmp_path / "scan.nii", volume)
    bench = Bench(spin, client, volume_file=str(tmp_path / "scan.nii"), spacing_um=[40.0, 5.0, 20.0])
    bench.scan()
    np.testing.assert_array_equal(conversions.image_to_array(bench.bscan.messages[-1]), volume.array[-1])
    last = bench.bscan_pose.wait(TIMEOUT_S, lambda message: message.pose.position.y > 3.5 * 40e-6)
    assert last.pose.position.y == pytest.approx(4 * 40e-6)


def test_a_phantom_that_cannot_be_is_refused_at_the_start(spin: Callable[..., Any]) -> None:
    with pytest.raises(ConfigurationError, match="surface"):
        spin(Simulator, phantom__shape=list(SHAPE), phantom__surface_depth_m=0.5)
