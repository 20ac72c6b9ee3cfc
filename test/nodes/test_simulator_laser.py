"""The simulator's laser, what turns it off, and the record: the client plays the planner, and makes trouble."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3Stamped
from rosgraph_msgs.msg import Clock

from octn_ros.nodes import qos
from octn_ros.simulation import Arm, LaserConfig, PhantomTissue

TIMEOUT_S = 120.0
PERIOD_NS = 8_000_000
ON_THE_WAY_NS = 150_000_000  # of a request or message through the graph, beside other work on the machine


def test_an_abort_on_the_way_to_a_scan_cancels_the_scan(simulator_bench: Callable[..., Any], client: Any) -> None:
    bench = simulator_bench(on_time=True)
    bench.executing()
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


def test_an_abort_calls_a_scan_off_that_the_arm_need_not_move_for(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(bscan_period_s=10.0)
    assert bench.call("scan").success
    assert "a scan is running" in bench.call("scan").message
    assert "the scan is cancelled" in bench.call("abort").message
    bench.until("B-scans are not taken")
    assert bench.node._station.scan_stamp_ns == bench.node._player.unsent == 0
    assert bench.call("scan").success


def test_an_abort_ends_the_execution_and_the_plan(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(time_factor=0.01)
    assert "nothing" in bench.call("abort").message
    bench.planner.plan(bench.scan(), bench.line(5))
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
    told = len(bench.status.messages)
    bench.planner.plan(bench.scan(), bench.line(5))
    bench.until("staged", after=told)
    assert "enable_laser first" in bench.call("execute").message, "what was enabled before the abort is not any more"


def test_the_laser_is_off_within_a_control_period_of_an_abort(simulator_bench: Callable[..., Any], client: Any) -> None:
    bench = simulator_bench(on_time=True, laser__dwell_s=0.04)
    bench.executing()
    client.wait_for(lambda: len(bench.audit("shot")) >= 5, TIMEOUT_S, "five shots")
    asked_ns = client.node.get_clock().now().nanoseconds
    answer = bench.call("abort")
    answered_ns = client.node.get_clock().now().nanoseconds
    client.wait_for(lambda: bench.laser_on.messages[-1].data is False, TIMEOUT_S, "laser_on: false")
    dark_ns = client.node.get_clock().now().nanoseconds
    end, shots = bench.ended()
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
    assert len(bench.audit("shot")) == len(shots)


def test_the_laser_is_off_at_once_when_the_planner_is_lost(simulator_bench: Callable[..., Any], client: Any) -> None:
    bench = simulator_bench(on_time=True)
    bench.executing()
    client.node.destroy_publisher(bench.planner.waypoints)
    lost_ns = client.node.get_clock().now().nanoseconds
    end, shots = bench.ended("got nobody in the graph")
    assert shots[-1]["time_ns"] <= end["time_ns"]
    assert end["time_ns"] - lost_ns < 1_000_000_000, "the graph tells within a moment, the interlock in one period"


def test_the_laser_is_off_when_the_tissue_has_moved(simulator_bench: Callable[..., Any], client: Any) -> None:
    bench = simulator_bench(on_time=True)
    seen = client.watch(Vector3Stamped, "tissue_motion", qos.STREAM)
    bench.executing()
    bench.set("tissue.shift_m", [0.0, 90e-6, 0.0])
    seen.wait(TIMEOUT_S, lambda message: message.vector.y > 80e-6)
    bench.set("tissue.shift_m", [0.0, 300e-6, 0.0])
    moved_ns = client.node.get_clock().now().nanoseconds
    _, shots = bench.ended("um away")
    assert shots[-1]["time_ns"] < moved_ns + 5 * PERIOD_NS
    assert bench.scan() > 0, "a new scan sees the tissue where it is now"
    nearer = client.watch(Vector3Stamped, "tissue_motion", qos.STREAM)
    assert abs(nearer.wait(TIMEOUT_S).vector.y) < 50e-6


def test_the_laser_is_off_when_the_plan_has_become_too_old(simulator_bench: Callable[..., Any], client: Any) -> None:
    bench = simulator_bench(on_time=True)
    stamp_ns = bench.executing()
    age_s = (client.node.get_clock().now().nanoseconds - stamp_ns) * 1e-9 + 0.3
    bench.set("interlock.plan_max_age_s", age_s)
    end, shots = bench.ended("s old")
    (change,) = bench.audit("change")
    assert (change["name"], change["value"]) == ("interlock.plan_max_age_s", age_s)
    assert stamp_ns < change["time_ns"] <= end["time_ns"]
    assert (end["time_ns"] - stamp_ns) * 1e-9 >= age_s
    assert shots[-1]["time_ns"] <= end["time_ns"]


@pytest.mark.parametrize("how", ["disable", "withdraw", "replace"])
def test_the_laser_is_off_when_it_is_disabled_or_the_plan_withdrawn(
    simulator_bench: Callable[..., Any], how: str
) -> None:
    bench = simulator_bench(on_time=True)
    stamp_ns = bench.executing()
    if how == "disable":
        assert bench.enable(False).success
        bench.ended("disabled")
    else:
        bench.planner.plan(stamp_ns, bench.line(0 if how == "withdraw" else 5))
        end, _ = bench.ended()
        # Whichever is heard first: what is published, or the plan_status or a sign of life that names it.
        named = "withdrawn" if how == "withdraw" else "replaced"
        by_name = ("expected a plan_status with plan_hash", "got one with")
        assert any(words in end["reason"] for words in (f"the planner has {named} the plan", *by_name))


class SimulatedClock:
    """Publishes /clock, a hundredth of a second every hundredth."""

    def __init__(self, client: Any) -> None:
        self.now_s, self.runs = 100.0, True
        self._publisher = client.node.create_publisher(Clock, "/clock", 1)
        client.node.create_timer(0.01, self._tick)

    def _tick(self) -> None:
        self.now_s += 0.01 if self.runs else 0.0
        seconds, rest = divmod(self.now_s, 1.0)
        self._publisher.publish(Clock(clock=Time(sec=int(seconds), nanosec=int(rest * 1e9))))


def test_the_interlock_is_looked_at_while_simulated_time_stands(
    simulator_bench: Callable[..., Any], client: Any
) -> None:
    bench, clock = simulator_bench(on_time=True, use_sim_time=True), SimulatedClock(client)
    bench.executing()
    clock.runs = False
    bench.set("tissue.shift_m", [0.0, 300e-6, 0.0])
    bench.ended("um away")


@pytest.mark.parametrize("lit", [True, False])
def test_the_laser_is_off_when_the_clock_is_set_back(
    simulator_bench: Callable[..., Any], client: Any, lit: bool
) -> None:
    pace = {} if lit else {"time_factor": 0.01}  # then the arm is on its way for long
    bench, clock = simulator_bench(on_time=True, use_sim_time=True, **pace), SimulatedClock(client)
    scanned_ns = bench.staged()
    clock.now_s += 10.0  # or the plan would be younger than its scan
    client.wait_for(lambda: bench.node.get_clock().now().nanoseconds > scanned_ns + 9e9, TIMEOUT_S, "ten seconds")
    assert bench.call("execute").success
    if lit:
        bench.laser_on.wait(TIMEOUT_S, lambda message: message.data)
    clock.now_s -= 0.3
    end, _ = bench.ended("clock that goes on, got one set back by 0.")
    assert end["shots"] < 200


def test_a_plan_of_no_scan_is_not_staged_at_a_time_of_zero(simulator_bench: Callable[..., Any], client: Any) -> None:
    bench, clock = simulator_bench(on_time=True, use_sim_time=True), SimulatedClock(client)
    clock.now_s = 1.0
    bench.planner.plan(0, bench.line(5))
    bench.until("plan refused: expected a scan before its plan, got none yet")
    assert bench.enable().success
    assert "scan before its plan" in bench.call("execute").message


def test_a_fault_at_the_start_refuses_the_plan_and_the_node_lives_on(
    simulator_bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: Any) -> None:
        raise RuntimeError("a fault of ours")

    bench = simulator_bench(on_time=True)
    bench.staged()
    with monkeypatch.context() as patched:
        patched.setattr(Arm, "execute", broken)
        assert bench.call("execute").message == "execute refused: RuntimeError: a fault of ours"
    (end,) = bench.audit("end")
    assert (end["outcome"], end["reason"], end["shots"]) == ("aborted", "RuntimeError: a fault of ours", 0)
    assert "got none (the arm is idle)" in bench.call("execute").message
    bench.executing()


def test_an_execution_is_recorded_with_who_and_what(simulator_bench: Callable[..., Any], client: Any) -> None:
    bench = simulator_bench(operator="A. Surgeon", phantom__shape=[40, 64, 80])
    stamp_ns = bench.scan()
    bench.planner.plan(stamp_ns, bench.line(), speed_m_s=bench.SLOW_M_S)
    bench.until("staged")
    bench.enable()
    assert bench.call("execute").success
    figures = bench.until("done")
    (begun,), (end,), shots = bench.audit("execute"), bench.audit("end"), bench.audit("shot")
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


def test_without_a_record_nothing_is_fired(simulator_bench: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    bench = simulator_bench(audit_path=str(tmp_path / "file" / "audit.jsonl"))
    bench.planner.plan(bench.scan(), bench.line(5))
    bench.until("staged")
    bench.enable()
    answer = bench.call("execute")
    assert not answer.success
    assert "audit_path" in answer.message


def test_a_fault_in_a_step_turns_the_laser_off(
    simulator_bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = simulator_bench(on_time=True)
    bench.executing()

    def broken(*arguments: Any) -> float:
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(PhantomTissue, "fire", broken)
    bench.ended("a fault of ours")
    monkeypatch.undo()
    assert bench.scan() > 0, "the node lives on"
