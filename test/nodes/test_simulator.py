"""The simulator alone: the client plays trainer and planner, asks for what cannot be, and makes trouble."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseArray, PoseStamped, Vector3Stamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from octn_ros.errors import ConfigurationError
from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.simulator import Simulator
from octn_ros.planning import load_calibration
from octn_ros.resources import config_path
from octn_ros.simulation import LaserConfig, PhantomConfig, PhantomTissue, make_phantom
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
        self.status = client.watch(DiagnosticArray, "execution_status", qos.REPORTS)
        self.laser_on = client.watch(Bool, "laser_on")
        self.removed = client.watch(Image, "removed_depth")
        self.waypoints = client.node.create_publisher(PoseArray, "waypoints", qos.LATCHED)
        self.tool_path = client.node.create_publisher(PointCloud2, "tool_path", qos.LATCHED)
        given = {"phantom__shape": list(SHAPE), "phantom__surface": "flat", "time_factor": 100.0, **parameters}
        self.node = spin(Simulator, **given)
        self.bscans = given["phantom__shape"][0]
        for watch in (self.bscan, self.bscan_pose, self.ee_pose, self.status):
            watch.wait_matched(TIMEOUT_S)

    def call(self, name: str) -> Any:
        return self.client.call(Trigger, name, Trigger.Request(), TIMEOUT_S)

    def enable(self, on: bool = True) -> Any:
        return self.client.call(SetBool, "enable_laser", SetBool.Request(data=on), TIMEOUT_S)

    def set(self, name: str, value: Any) -> None:
        asked = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        (result,) = self.client.call(SetParameters, "simulator/set_parameters", asked, TIMEOUT_S).results
        assert result.successful, result.reason

    def scan(self, bscans: int = 0) -> int:
        """Scan once the simulator has met both subscriptions; return the stamp of B-scan 0."""
        before, count = len(self.bscan.messages), bscans or self.bscans
        self.client.wait_for(lambda: self.call("scan").success, TIMEOUT_S, "scan")
        self.bscan.wait(TIMEOUT_S, lambda message: len(self.bscan.messages) >= before + count)
        return conversions.stamp_to_ns(self.bscan.messages[before].header.stamp)

    def publish(
        self, stamp_ns: int, poses: np.ndarray, *, frame: str = "tool0", path_stamp_ns: int = 0, speed_m_s: float = 0.01
    ) -> None:
        count = len(poses)
        on, speed = np.ones(count), np.full(count, speed_m_s)
        rows = conversions.tool_path(poses, np.zeros(count), on, speed, np.zeros(count), on)
        self.tool_path.publish(conversions.to_cloud(rows, path_stamp_ns or stamp_ns, frame))
        self.waypoints.publish(conversions.to_pose_array(poses, stamp_ns, frame))

    def until(self, *words: str) -> dict[str, str]:
        message = self.status.wait(TIMEOUT_S, lambda message: all(word in status.read(message)[1] for word in words))
        return status.read(message)[2]


def line(count: int = 5, length_m: float = 1e-3) -> np.ndarray:
    """Waypoints along x in the end-effector frame."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = np.linspace(0.0, length_m, count), 0.1
    return poses


def audit(path: Path, event: str) -> list[dict[str, Any]]:
    """The lines of one kind of an audit record."""
    lines = (json.loads(text) for text in path.read_text(encoding="utf-8").splitlines())
    return [found for found in lines if found["event"] == event]


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


@pytest.mark.parametrize("half", ["waypoints", "tool_path"])
def test_either_half_of_an_empty_plan_withdraws_it_at_once(spin: Callable[..., Any], client: Any, half: str) -> None:
    bench = Bench(spin, client)
    stamp_ns = bench.scan()
    bench.publish(stamp_ns, line())
    bench.until("staged")
    if half == "waypoints":
        bench.waypoints.publish(conversions.to_pose_array(line(0), stamp_ns, "tool0"))
    else:
        bench.tool_path.publish(conversions.to_cloud(np.empty(0, conversions.TOOL_PATH), stamp_ns, "tool0"))
    bench.until("withdrawn")
    assert "withdrawn" in bench.call("execute").message


def test_a_staged_plan_does_not_outlive_its_planner(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client)
    bench.publish(bench.scan(), line())
    bench.until("staged")
    assert bench.enable().success
    client.node.destroy_publisher(bench.waypoints)
    bench.until("the planner is lost")
    bench.waypoints = client.node.create_publisher(PoseArray, "waypoints", qos.LATCHED)
    client.wait_for(lambda: bench.waypoints.get_subscription_count() > 0, TIMEOUT_S, "simulator")
    refused = bench.call("execute")
    assert not refused.success
    assert "is lost" in refused.message


def test_the_same_places_turned_otherwise_are_another_plan(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client)
    stamp_ns, turned = bench.scan(), line()
    turned[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    bench.publish(stamp_ns, turned)
    bench.until("5 waypoints staged")
    rows = conversions.tool_path(line(), *np.ones((5, 5)))
    staged, heard = len(bench.status.messages), bench.node._plans
    bench.tool_path.publish(conversions.to_cloud(rows, stamp_ns, "tool0"))
    client.wait_for(lambda: bytes(heard._tool_path.data) == rows.tobytes(), TIMEOUT_S, "tool path")
    bench.waypoints.publish(conversions.to_pose_array(turned, stamp_ns, "tool0"))
    bench.publish(stamp_ns, line(6))
    bench.until("6 waypoints staged")
    said = [status.read(message)[1] for message in bench.status.messages[staged:]]
    assert not any("5 waypoints" in words for words in said), said


def test_an_abort_on_the_way_to_a_scan_cancels_the_scan(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, **ON_TIME)
    executing(bench)
    client.wait_for(lambda: bench.node._station.arm.progress[0] > 20, TIMEOUT_S, "arm away from home")
    bench.call("abort")
    before = len(bench.bscan.messages)
    bench.set("time_factor", 0.01)
    assert "once the arm is back" in bench.call("scan").message
    assert "cancelled" in bench.call("abort").message
    bench.until("the scan is cancelled, 40 B-scans are not taken")
    assert bench.node._station.scan_stamp_ns == bench.node._player.unsent == 0
    bench.set("time_factor", 100.0)
    bench.scan()
    assert len(bench.bscan.messages) == before + bench.bscans


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


# --- the laser, its interlock, and the record

CUT_SHAPE = (40, 64, 80)
PERIOD_NS = 8_000_000
ON_THE_WAY_NS = 150_000_000  # of a request or message through the graph, beside other work on the machine
ON_TIME = {"time_factor": 1.0, "phantom__shape": list(CUT_SHAPE), "bscan_period_s": 1e-4}


SLOW_M_S = 1e-4  # a line of a millimetre takes ten seconds, 50 ms from waypoint to waypoint


def long_line() -> np.ndarray:
    """Two hundred waypoints on the surface of the phantom."""
    oct2ee = load_calibration(config_path("calibration.yaml")).oct2ee
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = np.linspace(0.05e-3, 1.05e-3, 200)
    poses[:, 1, 3], poses[:, 2, 3] = 0.5e-3, 0.25 * 63 * 14.59e-6
    return oct2ee @ poses


def begin(bench: Bench) -> int:
    """Scan, stage, enable and execute; return the stamp of the scan."""
    stamp_ns = bench.scan()
    bench.publish(stamp_ns, long_line(), speed_m_s=SLOW_M_S)
    bench.until("staged")
    assert bench.enable().success
    answer = bench.call("execute")
    assert answer.success, answer.message
    return stamp_ns


def executing(bench: Bench) -> int:
    """The same, until the laser is on."""
    stamp_ns = begin(bench)
    bench.laser_on.wait(TIMEOUT_S, lambda message: message.data)
    return stamp_ns


def ended(bench: Bench, path: Path, *words: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Wait for an aborted execution; return the end of its record and its shots."""
    values = bench.until("aborted", *words)
    assert (values["state"], values["laser_on"], values["laser_enabled"]) == ("aborted", "false", "false")
    bench.client.wait_for(lambda: bench.laser_on.messages[-1].data is False, TIMEOUT_S, "laser_on: false")
    (end,) = audit(path, "end")
    assert end["outcome"] == "aborted"
    return end, audit(path, "shot")


def test_the_laser_is_off_within_a_control_period_of_an_abort(
    spin: Callable[..., Any], client: Any, tmp_path: Path
) -> None:
    path = tmp_path / "audit.jsonl"
    bench = Bench(spin, client, audit_path=str(path), **{"laser__dwell_s": 0.04, **ON_TIME})
    executing(bench)
    client.wait_for(lambda: path.exists() and len(audit(path, "shot")) >= 5, TIMEOUT_S, "five shots")
    asked_ns = client.node.get_clock().now().nanoseconds
    answer = bench.call("abort")
    answered_ns = client.node.get_clock().now().nanoseconds
    client.wait_for(lambda: bench.laser_on.messages[-1].data is False, TIMEOUT_S, "laser_on: false")
    dark_ns = client.node.get_clock().now().nanoseconds
    end, shots = ended(bench, path)
    assert "aborted after" in answer.message
    assert asked_ns <= end["time_ns"] <= answered_ns
    assert end["time_ns"] - asked_ns < ON_THE_WAY_NS + PERIOD_NS
    assert dark_ns - asked_ns < 2 * ON_THE_WAY_NS + PERIOD_NS
    last = shots[-1]
    # The abort is obeyed when it is received; no shot goes on for a control period after that.
    assert last["time_ns"] + last["dwell_s"] * 1e9 <= end["time_ns"] + PERIOD_NS
    assert end["shots"] == len(shots) < 200
    assert not bench.call("execute").success
    bench.scan()
    assert len(audit(path, "shot")) == len(shots)


def test_the_laser_is_off_at_once_when_the_planner_is_lost(
    spin: Callable[..., Any], client: Any, tmp_path: Path
) -> None:
    path = tmp_path / "audit.jsonl"
    bench = Bench(spin, client, audit_path=str(path), **ON_TIME)
    executing(bench)
    client.node.destroy_publisher(bench.waypoints)
    lost_ns = client.node.get_clock().now().nanoseconds
    end, shots = ended(bench, path, "got none in the graph")
    assert shots[-1]["time_ns"] <= end["time_ns"]
    assert end["time_ns"] - lost_ns < 1_000_000_000, "the graph tells within a moment, the interlock in one period"


def test_the_laser_is_off_when_the_tissue_has_moved(spin: Callable[..., Any], client: Any, tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    bench = Bench(spin, client, audit_path=str(path), **ON_TIME)
    seen = client.watch(Vector3Stamped, "tissue_motion", qos.STREAM)
    executing(bench)
    bench.set("tissue.shift_m", [0.0, 90e-6, 0.0])
    seen.wait(TIMEOUT_S, lambda message: message.vector.y > 80e-6)
    bench.set("tissue.shift_m", [0.0, 300e-6, 0.0])
    moved_ns = client.node.get_clock().now().nanoseconds
    _, shots = ended(bench, path, "um away")
    assert shots[-1]["time_ns"] < moved_ns + 5 * PERIOD_NS
    assert bench.scan() > 0, "a new scan sees the tissue where it is now"
    nearer = client.watch(Vector3Stamped, "tissue_motion", qos.STREAM)
    assert abs(nearer.wait(TIMEOUT_S).vector.y) < 50e-6


def test_the_laser_is_off_when_the_plan_has_become_too_old(
    spin: Callable[..., Any], client: Any, tmp_path: Path
) -> None:
    path = tmp_path / "audit.jsonl"
    bench = Bench(spin, client, audit_path=str(path), **ON_TIME)
    stamp_ns = executing(bench)
    age_s = (client.node.get_clock().now().nanoseconds - stamp_ns) * 1e-9 + 0.3
    bench.set("interlock.plan_max_age_s", age_s)
    end, shots = ended(bench, path, "s old")
    (change,) = audit(path, "change")
    assert (change["name"], change["value"]) == ("interlock.plan_max_age_s", age_s)
    assert stamp_ns < change["time_ns"] <= end["time_ns"]
    assert (end["time_ns"] - stamp_ns) * 1e-9 >= age_s
    assert shots[-1]["time_ns"] <= end["time_ns"]


@pytest.mark.parametrize("how", ["disable", "withdraw", "replace"])
def test_the_laser_is_off_when_it_is_disabled_or_the_plan_withdrawn(
    spin: Callable[..., Any], client: Any, tmp_path: Path, how: str
) -> None:
    path = tmp_path / "audit.jsonl"
    bench = Bench(spin, client, audit_path=str(path), **ON_TIME)
    stamp_ns = executing(bench)
    if how == "disable":
        assert bench.enable(False).success
        ended(bench, path, "disabled")
    else:
        bench.publish(stamp_ns, line(0 if how == "withdraw" else 5))
        ended(bench, path, "withdrawn" if how == "withdraw" else "replaced")


def test_an_execution_is_recorded_with_who_and_what(spin: Callable[..., Any], client: Any, tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    bench = Bench(spin, client, audit_path=str(path), operator="A. Surgeon", phantom__shape=list(CUT_SHAPE))
    stamp_ns = bench.scan()
    values = {"state": "planned", "stamp_ns": str(stamp_ns), "waypoints": "200", "field_hash": "ab12" * 4}
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    report = DiagnosticArray(status=[DiagnosticStatus(name="planner: plan_status", values=pairs)])
    client.node.create_publisher(DiagnosticArray, "plan_status", qos.LATCHED).publish(report)
    bench.publish(stamp_ns, long_line(), speed_m_s=SLOW_M_S)
    bench.until("staged")
    bench.enable()
    assert bench.call("execute").success
    figures = bench.until("done")
    (begun,), (end,), shots = audit(path, "execute"), audit(path, "end"), audit(path, "shot")
    assert (begun["operator"], begun["planner"], begun["field_hash"]) == ("A. Surgeon", "planner", "ab12" * 4)
    assert begun["scan_stamp_ns"] == stamp_ns
    assert len(begun["scan_hash"]) == len(begun["plan_hash"]) == 16
    assert len(shots) == end["shots"] == int(figures["shots"]) == 200
    assert begun["time_ns"] < shots[0]["time_ns"] < shots[-1]["time_ns"] < end["time_ns"]
    assert float(figures["spot_error_rms_um"]) < 5.0
    assert figures["plan_hash"] == begun["plan_hash"]
    assert float(figures["removed_volume_mm3"]) == pytest.approx(
        200e9 * float(LaserConfig().removed_volume_m3(end["dwell_s"] / 200)), rel=0.05
    )


def test_without_a_record_nothing_is_fired(spin: Callable[..., Any], client: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    bench = Bench(spin, client, audit_path=str(tmp_path / "file" / "audit.jsonl"))
    bench.publish(bench.scan(), line())
    bench.until("staged")
    bench.enable()
    answer = bench.call("execute")
    assert not answer.success
    assert "audit_path" in answer.message


def test_a_second_scan_shows_the_crater(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, phantom__shape=list(CUT_SHAPE), laser__dwell_s=0.0015)
    begin(bench)
    bench.until("done")
    removed = conversions.image_to_array(
        bench.removed.wait(TIMEOUT_S, lambda message: max(conversions.image_to_array(message).ravel()) > 0)
    )
    assert removed.shape == (40, 80)
    before = len(bench.bscan.messages)
    bench.scan()
    scans = [
        np.stack([conversions.image_to_array(image) for image in images])
        for images in (bench.bscan.messages[:40], bench.bscan.messages[before : before + 40])
    ]
    row, column = np.unravel_index(np.argmax(removed), removed.shape)
    depths = [np.argmax(np.diff(scan[row, :, column - 1 : column + 2].mean(axis=1))) for scan in scans]
    assert (depths[1] - depths[0]) * 14.59e-6 == pytest.approx(removed[row, column], abs=2 * 14.59e-6)
    assert removed[row, column] > 50e-6
    far = scans[1][0].mean(axis=1) - scans[0][0].mean(axis=1)
    assert np.abs(far).max() < 20, "elsewhere it is the same tissue in other speckle"


def test_after_an_abort_the_arm_goes_back_before_it_scans(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, **ON_TIME)
    executing(bench)
    home = bench.ee_pose.messages[0].pose.position
    bench.call("abort")
    bench.until("aborted")
    away = len(bench.ee_pose.messages)
    stopped = bench.ee_pose.wait(TIMEOUT_S, after=away).pose.position
    assert abs(stopped.x - home.x) + abs(stopped.y - home.y) > 1e-4
    before = len(bench.bscan.messages)
    answer = bench.call("scan")
    assert answer.success, answer.message
    assert "once the arm is back" in answer.message
    first = bench.bscan.wait(TIMEOUT_S, after=before)
    pose = bench.ee_pose.wait(
        TIMEOUT_S,
        lambda message: conversions.stamp_to_ns(message.header.stamp) >= conversions.stamp_to_ns(first.header.stamp),
    )
    place = pose.pose.position
    assert (place.x, place.y, place.z) == pytest.approx((home.x, home.y, home.z), abs=1e-9)


def test_a_sparse_scan_takes_as_much_less_time(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, phantom__shape=list(CUT_SHAPE), bscan_factor=4, bscan_period_s=0.01)
    bench.scan(bscans=10)
    stamps = [conversions.stamp_to_ns(image.header.stamp) for image in bench.bscan.messages]
    np.testing.assert_array_equal(np.diff(stamps), 10_000_000)
    bench.bscan_pose.wait(TIMEOUT_S, lambda message: len(bench.bscan_pose.messages) >= 10)
    places = [pose.pose.position.y for pose in bench.bscan_pose.messages]
    np.testing.assert_allclose(places, 4 * 28e-6 * np.arange(10), atol=1e-12)
    assert len(bench.bscan.messages) == 10


def test_a_fault_in_a_step_turns_the_laser_off(
    spin: Callable[..., Any], client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "audit.jsonl"
    bench = Bench(spin, client, audit_path=str(path), **ON_TIME)
    executing(bench)

    def broken(*arguments: Any) -> float:
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(PhantomTissue, "fire", broken)
    ended(bench, path, "a fault of ours")
    monkeypatch.undo()
    assert bench.scan() > 0, "the node lives on"


def test_a_best_effort_scanner_says_so(spin: Callable[..., Any], client: Any) -> None:
    spin(Simulator, phantom__shape=list(SHAPE), bscan_reliability="best_effort")
    heard = client.watch(Image, "bscan", qos.scan_profile(SHAPE[0], "best_effort"))
    client.watch(PoseStamped, "bscan_pose", qos.scan_profile(SHAPE[0], "best_effort"))
    client.wait_for(lambda: client.call(Trigger, "scan", Trigger.Request(), TIMEOUT_S).success, TIMEOUT_S, "scan")
    assert heard.wait(TIMEOUT_S).height == SHAPE[1]
