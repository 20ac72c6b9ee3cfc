"""Plans as the simulator takes them: whole ones, from one planner that lives and stands for them."""

from __future__ import annotations

import hashlib
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import PointCloud2

from octn_ros.nodes import conversions, qos, status

TIMEOUT_S = 120.0
SILENCE_S, PERIOD_S = 1.6, 0.008
ON_THE_WAY_S = 0.5  # of a message through the graph, beside other work on the machine
TOPICS = {"waypoints": PoseArray, "tool_path": PointCloud2, "plan_status": DiagnosticArray}


def refused(bench: Any, *words: str) -> None:
    """See that an execution is refused in these words, with the laser enabled."""
    assert bench.enable().success
    answer = bench.call("execute")
    assert not answer.success
    assert answer.message.startswith("execute refused: expected")
    for word in words:
        assert word in answer.message


def done(bench: Any) -> None:
    """See that an execution succeeds."""
    assert bench.enable().success
    told, answer = len(bench.status.messages), bench.call("execute")
    assert answer.success, answer.message
    bench.until("done", after=told)


def test_a_plan_is_staged_on_receipt_and_runs_only_on_execute(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    bench.planner.plan(bench.scan(), bench.line(5))
    assert bench.until("5 waypoints staged")["shots"] == "0"
    disabled = bench.call("execute")
    assert not disabled.success
    assert "enable_laser" in disabled.message
    done(bench)
    assert bench.until("done")["shots"] == "5"


def test_a_plan_of_tissue_that_has_been_fired_at_is_staged_with_a_warning(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("5 waypoints staged")
    done(bench)
    told = len(bench.status.messages)
    bench.planner.plan(stamp_ns, bench.line(4))
    bench.until("4 waypoints staged; the laser has fired since the scan", after=told)
    assert bench.status.messages[-1].status[0].level == status.WARN
    done(bench)
    assert bench.until("executing 4 waypoints; the laser has fired since the scan")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stamp_offset_ns": 1}, "another scan"),
        ({"frame": "oct_optical_frame"}, "'tool0'"),
        ({"away_m": 2.0}, "reach"),
        ({"speed_m_s": 0.0}, "speeds of at least 1e-06 m/s, got 0"),
        ({"speed_m_s": np.nan}, "got nan at waypoint 0"),
        ({"speed_m_s": np.inf}, "got inf at waypoint 0"),
        ({"away_m": np.nan}, "finite poses with unit quaternions"),
    ],
)
def test_a_plan_that_cannot_run_is_refused(
    simulator_bench: Callable[..., Any], changes: dict[str, Any], reason: str
) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan() + changes.pop("stamp_offset_ns", 0)
    bench.planner.plan(stamp_ns, bench.line(5) + changes.pop("away_m", 0.0) * np.eye(4, k=3), **changes)
    bench.until("plan refused", reason)
    refused(bench, reason)


def test_waypoints_without_their_tool_path_are_not_staged(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns + 1, bench.line(5))
    bench.until("another scan")
    bench.planner.waypoints.publish(conversions.to_pose_array(bench.line(5), stamp_ns, "tool0"))
    refused(bench, "staged plan, got none")
    bench.planner.plan(stamp_ns, bench.line(7))
    bench.until("7 waypoints staged")


def test_halves_of_one_stamp_in_two_frames_are_refused(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5), frame="oct_optical_frame")
    bench.until("plan refused", "in frame 'tool0'")
    bench.planner.waypoints.publish(conversions.to_pose_array(bench.line(5), stamp_ns, "tool0"))
    bench.until("plan refused", "one frame, got 'tool0' and 'oct_optical_frame'")
    refused(bench, "one frame")


@pytest.mark.parametrize("half", ["waypoints", "tool_path"])
def test_either_half_of_an_empty_plan_withdraws_it_at_once(simulator_bench: Callable[..., Any], half: str) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("staged")
    if half == "waypoints":
        bench.planner.waypoints.publish(conversions.to_pose_array(bench.line(0), stamp_ns, "tool0"))
    else:
        bench.planner.tool_path.publish(conversions.to_cloud(np.empty(0, conversions.TOOL_PATH), stamp_ns, "tool0"))
    bench.until("withdrawn")
    refused(bench, "withdrawn")


def test_a_staged_plan_does_not_outlive_its_planner(
    simulator_bench: Callable[..., Any], planner_stand_in: Callable[[], Any]
) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("staged")
    told = len(bench.status.messages)
    bench.planner.leave()
    bench.until("dropped", "got nobody in the graph", after=told)
    bench.planner = planner_stand_in()
    bench.client.wait_for(lambda: bench.node._plans.voucher().why_nobody is None, TIMEOUT_S, "a planner")
    refused(bench, "got nobody in the graph")
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("5 waypoints staged", after=told)
    done(bench)


def test_the_same_places_turned_otherwise_are_another_plan(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    stamp_ns, turned = bench.scan(), bench.line(5)
    turned[:, :3, :3] = turned[:, :3, :3] @ np.diag([1.0, -1.0, -1.0])
    bench.planner.plan(stamp_ns, turned)
    bench.until("5 waypoints staged")
    rows = conversions.tool_path(bench.line(5), *np.ones((5, 5)))
    staged, heard = len(bench.status.messages), bench.node._plans
    bench.planner.tool_path.publish(conversions.to_cloud(rows, stamp_ns, "tool0"))
    bench.client.wait_for(lambda: bytes(heard._tool_path.data) == rows.tobytes(), TIMEOUT_S, "tool path")
    bench.planner.waypoints.publish(conversions.to_pose_array(turned, stamp_ns, "tool0"))
    bench.planner.plan(stamp_ns, bench.line(6))
    bench.until("6 waypoints staged")
    said = [status.read(message)[1] for message in bench.status.messages[staged:]]
    assert not any("5 waypoints" in words for words in said), said


# --- who stands for a plan


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ({"plan_hash": "0123456789abcdef"}, "got 0123456789abcdef, "),
        ({"plan_hash": ""}, "got none, "),
        ({"scan": "12"}, ", 12 and ab12"),
        ({"field_hash": ""}, "and none; plan again"),
    ],
)
def test_a_plan_that_its_planner_does_not_name_is_not_staged(
    simulator_bench: Callable[..., Any], said: dict[str, str], reason: str
) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5), **said)
    assert bench.until("plan of 5 waypoints waits", reason)["state"] == "idle"
    refused(bench, "expected a plan_status with plan_hash", reason)
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("5 waypoints staged")
    done(bench)


def test_a_planner_without_plan_status_is_told_so(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    bench.client.node.destroy_publisher(bench.planner.status)
    bench.planner.say = lambda **said: None
    bench.planner.plan(bench.scan(), bench.line(5))
    bench.until("waits", "nobody in the graph who publishes plan_status;")


def test_a_staged_plan_is_fired_only_while_its_planner_stands_for_it(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("staged")
    staged = bench.node._station.staged
    known = staged.hash
    bench.planner.say(str(stamp_ns), "", state="ready")
    bench.client.wait_for(lambda: not bench.node._plans.voucher().plan_hash, TIMEOUT_S, "plan_status")
    refused(bench, f"plan_hash {known}, stamp_ns {stamp_ns} and a field_hash, got none, {stamp_ns} and")
    bench.planner.say(str(stamp_ns), known, state="refused")  # another request was, the plan stands
    bench.client.wait_for(lambda: bench.node._plans.voucher().why_not(staged, 5.0) is None, TIMEOUT_S, "a planner")
    done(bench)


def test_the_laser_is_off_when_the_planner_names_another_plan(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(on_time=True)
    stamp_ns = bench.executing()
    bench.planner.say(str(stamp_ns), "0123456789abcdef")
    bench.ended("0123456789abcdef")  # by plan_status or a sign of life, whichever is heard first


def test_a_planner_that_hangs_is_fired_for_no_longer_than_the_limit(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(on_time=True, interlock__planner_silence_s=SILENCE_S, interlock__longest_stall_s=0.5)
    bench.staged()
    bench.planner.lives = False
    time.sleep(SILENCE_S + ON_THE_WAY_S)
    refused(bench, "(node /octn/client) on /diagnostics", f"every {SILENCE_S} s, got none for")
    bench.planner.lives = True
    bench.client.wait_for(lambda: bench.node._plans.voucher().silent_s < 1.0, TIMEOUT_S, "a sign of life")
    answer = bench.call("execute")
    assert answer.success, answer.message
    bench.laser_on.wait(TIMEOUT_S, lambda message: message.data)
    bench.planner.lives, asked_ns = False, bench.client.node.get_clock().now().nanoseconds
    end, shots = bench.ended("sign of life", "got none for")
    silent_s = (end["time_ns"] - asked_ns) * 1e-9
    assert SILENCE_S - ON_THE_WAY_S < silent_s < SILENCE_S + PERIOD_S + ON_THE_WAY_S
    assert shots[-1]["time_ns"] <= end["time_ns"]


def test_the_laser_is_off_when_the_signs_of_life_name_another_plan(simulator_bench: Callable[..., Any]) -> None:
    """Of two planners of one name the one that goes may have said the plan, and the one that stays says it lives."""
    bench = simulator_bench(on_time=True)
    bench.executing()
    bench.planner._stands = "0123456789abcdef"
    bench.ended("sign of life", "got one with 0123456789abcdef")


def test_a_limit_below_that_of_a_sign_of_life_is_refused(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(interlock__longest_stall_s=0.5)
    assert "planner_silence_s above 5.5 s" in bench.set("interlock.longest_stall_s", 4.5).reason
    assert "planner_silence_s above 1.5 s" in bench.set("interlock.planner_silence_s", 1.5).reason
    assert bench.set("interlock.planner_silence_s", 5.6).successful
    assert bench.set("interlock.longest_stall_s", 4.5).successful


@pytest.mark.parametrize("topic", TOPICS)
def test_a_second_publisher_stops_the_laser_until_it_is_gone(simulator_bench: Callable[..., Any], topic: str) -> None:
    bench = simulator_bench(on_time=True)
    bench.executing()
    another = bench.client.node.create_publisher(TOPICS[topic], topic, qos.LATCHED)
    bench.ended(f"{topic} from 2")
    told, stamp_ns = len(bench.status.messages), bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("plan refused", f"{topic} from 2", "wait", after=told)
    refused(bench, f"{topic} from 2")
    bench.client.node.destroy_publisher(another)
    bench.client.wait_for(lambda: bench.node._plans.voucher().why_nobody is None, TIMEOUT_S, "one planner")
    refused(bench, "plan again")
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("5 waypoints staged", after=told)
    done(bench)


def test_a_staged_plan_is_dropped_where_another_publisher_comes(
    simulator_bench: Callable[..., Any], planner_stand_in: Callable[[], Any]
) -> None:
    bench = simulator_bench()
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("5 waypoints staged")
    another = planner_stand_in()
    another.lives = False
    bench.until("plan refused", "waypoints from 2")
    another.plan(stamp_ns, bench.line(7))  # some of it may be heard only when it has left
    another.leave()
    bench.client.wait_for(lambda: bench.node._plans.voucher().why_nobody is None, TIMEOUT_S, "one planner")
    refused(bench, "staged plan, got none")
    told = len(bench.status.messages)
    bench.planner.plan(stamp_ns, bench.line(5))
    bench.until("5 waypoints staged", after=told)
    done(bench)
    said = [status.read(message)[1] for message in bench.status.messages]
    assert not any("7 waypoints staged" in words for words in said), said


def test_the_name_of_a_plan_can_be_worked_out_from_its_bytes() -> None:
    """As docs/connecting.md has it, with nothing of ours."""
    pose = np.eye(4)
    pose[:3, 3] = 0.25, -0.5, 0.125
    message = conversions.to_cloud(
        conversions.tool_path(pose[None], *np.array([[3], [1], [0.5], [0.0], [1.0]])),
        1_764_000_000_123_456_789,
        "tool0",
    )
    row = struct.pack("<7fIB3f", 0.25, -0.5, 0.125, 0.0, 0.0, 0.0, 1.0, 3, 1, 0.5, 0.0, 1.0)
    assert len(row) == 45
    expected = hashlib.sha256(b"1764000000123456789 tool0\n" + row).hexdigest()[:16]
    page = (Path(__file__).parents[2] / "docs" / "connecting.md").read_text(encoding="utf-8")
    assert conversions.plan_hash(message) == expected
    assert f'sha256("1764000000123456789 tool0\\n" + 45 bytes) = {expected}...' in page
