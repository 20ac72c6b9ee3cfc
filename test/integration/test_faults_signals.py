"""An interrupt in every state of planner, query and simulator, and an abort in mid-raster."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan, LoadMap
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from octn_ros.field import InterpolatedField, dumps_field
from octn_ros.nodes import conversions, qos, status
from octn_ros.planning import load_calibration
from octn_ros.resources import config_path
from octn_ros.simulation import PhantomConfig, make_phantom

START_S, ANSWER_S = 180.0, 120.0
STAMP_NS = 2_000_000_000
OCT = "oct_optical_frame"
LARGE = PhantomConfig(shape=(128, 160, 128), surface="wavy", spacing_m=(3e-5, 1e-5, 3e-5))
BUSY_S = 0.3  # of computing: what was asked for is under way

SHAPE = (40, 64, 80)
PERIOD_S = 0.008
SIMULATOR = (f"phantom.shape:={list(SHAPE)}", "phantom.surface:=flat", "time_factor:=1.0")
QUICK, SLOW = "bscan_period_s:=0.0001", "bscan_period_s:=1.0"


def computed_s(pid: int) -> float:
    """Return the processor time that a process has used, of all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


def wait_busy(process: Any) -> None:
    """Return once a process has computed for a while."""
    before, deadline = computed_s(process.popen.pid), time.monotonic() + START_S
    while computed_s(process.popen.pid) < before + BUSY_S:
        assert time.monotonic() < deadline, "the process has nothing to do"
        time.sleep(0.005)


# --- planner and query


def corners(size_m: float, tolerance_m: float) -> Any:
    request = GetPlan.Request(tolerance=tolerance_m)
    for pose, place_m in ((request.start, 3e-4), (request.goal, 3e-4 + size_m)):
        pose.header.frame_id = OCT
        pose.pose.position.x = pose.pose.position.y = place_m
    return request


@pytest.fixture
def give_field(client: Any) -> Callable[[], None]:
    volume = dataclasses.replace(make_phantom(LARGE).truth, stamp_ns=STAMP_NS)
    message = conversions.to_field_message(dumps_field(InterpolatedField(volume)), STAMP_NS, OCT)
    publisher = client.node.create_publisher(CompressedImage, "field", qos.LATCHED)
    return lambda: publisher.publish(message)


def ready(client: Any, launch: Callable[..., Any], node: str, topic: str, give: Callable[[], None]) -> Any:
    """Start a node and return it once it has the field."""
    reports = client.watch(DiagnosticArray, topic)
    process = launch(node, "device:=cpu")
    give()
    reports.wait(START_S, lambda message: status.read(message)[2].get("state") == "ready")
    return process


@pytest.mark.slow
@pytest.mark.parametrize("state", ["no field", "field", "plan stands", "planning"])
def test_an_interrupt_ends_the_planner(
    launch: Callable[..., Any], client: Any, give_field: Callable[[], None], state: str
) -> None:
    if state == "no field":
        process = launch("planner", "device:=cpu")
        client.watch(DiagnosticArray, "/diagnostics", qos.STREAM).wait(START_S)
    else:
        process = ready(client, launch, "planner", "plan_status", give_field)
    if state in ("plan stands", "planning"):
        assert client.call(GetPlan, "plan_raster", corners(6e-4, 1e-4), ANSWER_S).plan.poses
    if state == "planning":
        client.node.create_client(GetPlan, "plan_raster").call_async(corners(3.1e-3, 1e-5))
        wait_busy(process)
    process.end()


@pytest.mark.slow
@pytest.mark.parametrize("state", ["no field", "field", "slicing", "a line"])
def test_an_interrupt_ends_the_query_node(
    launch: Callable[..., Any], client: Any, give_field: Callable[[], None], state: str
) -> None:
    if state == "no field":
        process = launch("query", "device:=cpu")
        client.watch(DiagnosticArray, "/diagnostics", qos.STREAM).wait(START_S)
    else:
        process = ready(client, launch, "query", "query_status", give_field)
    if state == "slicing":
        assert client.call(LoadMap, "query_slice", LoadMap.Request(map_url="bscan:3"), ANSWER_S).map.data
        service = client.node.create_client(LoadMap, "query_slice")
        for _ in range(5):
            service.call_async(LoadMap.Request(map_url="enface:mip"))
    elif state == "a line":
        assert client.call(GetPlan, "query_surface", corners(1e-3, 1e-4), ANSWER_S).plan.poses
        client.node.create_client(GetPlan, "query_surface").call_async(corners(3.1e-3, 1e-6))
    process.end()


# --- simulator


class Station:
    """The simulator in a process, and a client that plays trainer, planner and surgeon."""

    def __init__(self, launch: Callable[..., Any], client: Any, folder: Path, *assignments: str) -> None:
        self.client, self.audit_path = client, folder / "audit.jsonl"
        profile = qos.scan_profile(SHAPE[0])
        self.bscan = client.watch(Image, "bscan", profile)
        self.bscan_pose = client.watch(PoseStamped, "bscan_pose", profile)
        self.laser_on = client.watch(Bool, "laser_on")
        self.execution = client.watch(DiagnosticArray, "execution_status")
        self.process = launch("simulator", *SIMULATOR, f"audit_path:={self.audit_path}", *assignments)
        self.execution.wait(START_S)
        for watch in (self.bscan, self.bscan_pose):
            watch.wait_matched(START_S)

    def trigger(self, name: str) -> Any:
        return self.client.call(Trigger, name, Trigger.Request(), ANSWER_S)

    def until(self, state: str) -> None:
        self.execution.wait(ANSWER_S, lambda message: status.read(message)[2]["state"] == state)

    def scan(self) -> int:
        """Scan, and return the stamp of the first image once it has come."""
        self.client.wait_for(lambda: self.trigger("scan").success, START_S, "scan")
        return conversions.stamp_to_ns(self.bscan.wait(ANSWER_S).header.stamp)

    def stage(self, planner: Any) -> None:
        """Scan and publish two hundred waypoints, ten seconds of work."""
        stamp_ns = self.scan()
        self.bscan.wait(ANSWER_S, lambda message: len(self.bscan.messages) == SHAPE[0])
        poses = np.tile(np.eye(4), (200, 1, 1))
        poses[:, 0, 3] = np.linspace(0.05e-3, 1.05e-3, 200)
        poses[:, 1, 3], poses[:, 2, 3] = 0.5e-3, 0.25 * 63 * 14.59e-6
        planner.plan(stamp_ns, load_calibration(config_path("calibration.yaml")).oct2ee @ poses, speed_m_s=1e-4)
        self.until("staged")

    def execute(self) -> None:
        """Enable the laser, execute, and return once the laser is on."""
        assert self.client.call(SetBool, "enable_laser", SetBool.Request(data=True), ANSWER_S).success
        answer = self.trigger("execute")
        assert answer.success, answer.message
        self.laser_on.wait(ANSWER_S, lambda message: message.data)

    def audit(self, event: str) -> list[dict[str, Any]]:
        """Return the lines of one kind of the audit record."""
        lines = [json.loads(line) for line in self.audit_path.read_text(encoding="utf-8").splitlines()]
        return [line for line in lines if line["event"] == event]


@pytest.mark.slow
@pytest.mark.parametrize("state", ["idle", "scanning", "staged", "executing", "aborted", "returning"])
def test_an_interrupt_ends_the_simulator_and_the_laser_is_off(
    launch: Callable[..., Any], client: Any, planner_stand_in: Callable[[], Any], tmp_path: Path, state: str
) -> None:
    station = Station(launch, client, tmp_path, SLOW if state == "scanning" else QUICK)
    if state == "scanning":
        station.scan()
    elif state != "idle":
        station.stage(planner_stand_in())
    if state in ("executing", "aborted", "returning"):
        station.execute()
    if state in ("aborted", "returning"):
        assert station.trigger("abort").success
    if state == "returning":
        assert station.trigger("scan").success
        station.until("returning")
    station.process.end()
    if state in ("executing", "aborted", "returning"):
        (end,) = station.audit("end")
        last = station.audit("shot")[-1]
        assert last["time_ns"] + last["dwell_s"] * 1e9 <= end["time_ns"] + PERIOD_S * 1e9


@pytest.mark.slow
def test_the_laser_is_off_within_a_control_period_of_an_abort(
    launch: Callable[..., Any], client: Any, planner_stand_in: Callable[[], Any], tmp_path: Path
) -> None:
    station = Station(launch, client, tmp_path, QUICK, "laser.dwell_s:=0.04")
    station.stage(planner_stand_in())
    station.execute()
    client.wait_for(lambda: len(station.audit("shot")) >= 5, ANSWER_S, "five shots")
    asked_ns = time.time_ns()
    assert "aborted after" in station.trigger("abort").message
    answered_ns = time.time_ns()
    client.wait_for(lambda: station.laser_on.messages[-1].data is False, ANSWER_S, "laser_on: false")
    (end,) = station.audit("end")
    assert asked_ns <= end["time_ns"] <= answered_ns
    shots = station.audit("shot")
    assert shots[-1]["time_ns"] + shots[-1]["dwell_s"] * 1e9 <= end["time_ns"] + PERIOD_S * 1e9
    assert not station.trigger("execute").success
    station.process.end()
    assert station.audit("shot") == shots
