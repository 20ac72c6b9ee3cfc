"""The scanner and the arm of examples/, with the real trainer and planner: from `scan` to the last waypoint."""

from __future__ import annotations

import contextlib
import importlib.util
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool, Trigger

from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.planner import Planner
from octn_ros.nodes.trainer import Trainer

EXAMPLES = Path(__file__).parents[1] / "examples"
WAIT_S = 120.0
SPACING_UM = [28.0, 14.59, 14.0]
SMALL_FIT = {"fit__steps": 60, "fit__time_budget_s": 0.0, "fit__field__grid__log2_table_size": 12}
CLIENT = EXAMPLES / "scan_plan_execute.py"
INSIDE = ("0.15", "0.15", "0.5", "0.5")


def example(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_scanner_and_an_arm_of_sixty_lines_are_enough(spin: Callable[..., Any], client: Any) -> None:
    scanner, arm = example("minimal_scanner"), example("minimal_arm")
    progress = client.watch(DiagnosticArray, "fit_progress")
    planner = client.watch(DiagnosticArray, "plan_status")
    base = client.watch(PoseArray, "waypoints_base")
    spin(Trainer, device="cpu", bscan_count=scanner.BSCANS, spacing_um=SPACING_UM, field_path="", **SMALL_FIT)
    spin(Planner, device="cpu")
    scanning, moving = spin(lambda **_: scanner.MinimalScanner()), spin(lambda **_: arm.MinimalArm())
    for publisher in (scanning._image, scanning._pose, moving._ee_pose):
        client.wait_for(lambda publisher=publisher: publisher.get_subscription_count() > 0, WAIT_S, "trainer")
    refused = client.call(Trigger, "execute", Trigger.Request(), WAIT_S)
    assert (refused.success, refused.message) == (False, "there is no plan")

    assert client.call(Trigger, "scan", Trigger.Request(), WAIT_S).success
    progress.wait(WAIT_S, lambda report: status.read(report)[2].get("state") == "done")
    planner.wait(WAIT_S, lambda report: status.read(report)[2].get("field_kind") == "neural")
    request = GetPlan.Request(tolerance=100e-6)
    for pose, corner in ((request.start, 0.15e-3), (request.goal, 0.5e-3)):
        pose.header.frame_id = "oct_optical_frame"
        pose.pose.position.x = pose.pose.position.y = corner
    path = client.call(GetPlan, "plan_raster", request, WAIT_S).plan
    assert path.poses, status.read(planner.messages[-1])[1]
    # The layer begins at row 22, which is the depth of every waypoint in the OCT frame.
    oct2ee = moving._calibration.oct2ee
    places = conversions.poses_to_matrices([pose.pose for pose in path.poses])[:, :3, 3]
    depth_m = ((places - oct2ee[:3, 3]) @ oct2ee[:3, :3])[:, 2]
    np.testing.assert_allclose(depth_m, 21.5 * 14.59e-6, atol=20e-6)

    planned = base.wait(WAIT_S, lambda message: len(message.poses) == len(path.poses))
    executed = client.watch(DiagnosticArray, "execution_status")
    executed.wait(WAIT_S, lambda report: status.read(report)[2]["state"] == "staged")
    disabled = client.call(Trigger, "execute", Trigger.Request(), WAIT_S)
    assert (disabled.success, disabled.message) == (False, "the laser is disabled; call enable_laser")
    assert not moving.reached
    assert client.call(SetBool, "enable_laser", SetBool.Request(data=True), WAIT_S).message == "the laser is enabled"
    done = client.call(Trigger, "execute", Trigger.Request(), WAIT_S)
    assert done.success, done.message
    executed.wait(WAIT_S, lambda report: status.read(report)[2]["state"] == "done")
    expected = conversions.poses_to_matrices(planned.poses)[:, :3, 3]
    np.testing.assert_allclose(np.array(moving.reached), expected, atol=1e-6)  # the tool path has float32

    # A plan that is taken back during the execution stops the arm there.
    go, moving.reached = moving._go, []

    def taken_back(*order: Any) -> None:
        go(*order)
        moving._laser_enabled = len(moving.reached) < 3

    moving._go = taken_back
    stopped = client.call(Trigger, "execute", Trigger.Request(), WAIT_S)
    assert (stopped.success, len(moving.reached)) == (False, 3)
    assert stopped.message == "aborted after 3 waypoints: plan or laser was taken back"


def test_the_page_states_the_bytes_of_a_tool_path() -> None:
    page = (EXAMPLES.parent / "docs" / "connecting.md").read_text(encoding="utf-8")
    assert f"`point_step` {conversions.TOOL_PATH.itemsize}" in page
    rows = re.findall(
        r"^\| (\d+)(?: to (\d+))?, (?:(?:seven|three) )?(float32|uint32|uint8) \|(.*)", page, re.MULTILINE
    )
    columns = {}
    for first, last, kind, words in rows:
        names = [name for name in re.findall(r"`(\w+)`", words) if name in conversions.TOOL_PATH.names]
        size = np.dtype(kind).itemsize
        assert int(last or first) + 1 - int(first) == size * len(names)
        columns |= {name: (int(first) + size * index, kind) for index, name in enumerate(names)}
    assert columns == {name: (at, str(kind)) for name, (kind, at) in conversions.TOOL_PATH.fields.items()}


def test_the_scanner_waits_for_a_trainer(spin: Callable[..., Any], client: Any) -> None:
    scanner = example("minimal_scanner")
    scanning = spin(lambda **_: scanner.MinimalScanner())
    asked = client.call(Trigger, "scan", Trigger.Request(), WAIT_S)
    assert asked.message == "scanning 32 B-scans once a trainer subscribes to bscan and bscan_pose"
    poses = client.watch(PoseStamped, "bscan_pose", QoSProfile(depth=scanner.BSCANS))
    client.wait_for(lambda: scanning._pose.get_subscription_count() > 0, WAIT_S, "bscan_pose")
    assert not poses.messages, "nobody hears the images yet"
    images = client.watch(Image, "bscan", QoSProfile(depth=scanner.BSCANS))
    client.wait_for(lambda: len(images.messages) == len(poses.messages) == scanner.BSCANS, WAIT_S, "a whole C-scan")
    assert poses.messages[0].pose.position.y == 0.0


@contextlib.contextmanager
def running(*corners_mm: str) -> Iterator[subprocess.Popen[str]]:
    """The client of examples/ as a program, ended with the test."""
    command = [sys.executable, "-W", "error", str(CLIENT), *corners_mm]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        try:
            yield program
        finally:
            program.kill()


@pytest.mark.parametrize(("opposite_mm", "code"), [("0.5", 0), ("5", 1)])
def test_the_client_works_scanner_and_arm(spin: Callable[..., Any], opposite_mm: str, code: int) -> None:
    scanner, arm = example("minimal_scanner"), example("minimal_arm")
    with running("0.15", "0.15", opposite_mm, opposite_mm) as program:
        assert program.stderr is not None
        waits = program.stderr.readline()
        assert waits == "waiting for a trainer: somebody who subscribes to bscan\n"
        spin(Planner, device="cpu")
        spin(lambda **_: scanner.MinimalScanner())
        spin(lambda **_: arm.MinimalArm())
        spin(Trainer, device="cpu", bscan_count=scanner.BSCANS, spacing_um=SPACING_UM, field_path="", **SMALL_FIT)
        said, complained = program.communicate(timeout=WAIT_S)
    lines = said.splitlines()
    assert program.returncode == code, complained
    assert lines[0].startswith("scan: scanning 32 B-scans")
    if code:
        assert len(lines) == 1
        assert "scan_plan_execute: error: planner: plan_raster refused: " in complained
        assert "Traceback" not in complained
        return
    count = int(lines[1].split()[1])
    assert count > 10
    assert lines[1].startswith(f"plan: {count} waypoints in tool0")
    assert lines[2:] == [f"execute: {count} waypoints reached", f"arm: {count} waypoints reached"]


def test_the_client_says_who_has_left_and_what_was_said_last(client: Any) -> None:
    program, report = (
        example("scan_plan_execute"),
        DiagnosticArray(status=[DiagnosticStatus(message="plan refused: 2")]),
    )
    watch = client.watch(DiagnosticArray, "execution_status")

    def wait() -> Any:
        return program.wait_for_report(client, watch, "execution_status", 0.1, lambda message: False)

    with pytest.raises(program.RefusedError, match="execution_status: its node has left the graph"):
        wait()
    arm = client.node.create_publisher(DiagnosticArray, "execution_status", qos.LATCHED)
    arm.publish(report)
    watch.wait(WAIT_S)
    with pytest.raises(TimeoutError, match=r"in 0\.1 s; the last report: \['plan refused: 2'\]"):
        wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_client_with_one_line(number: int) -> None:
    with running(*INSIDE) as program:
        assert program.stderr is not None
        assert program.stderr.readline().startswith("waiting for a trainer")
        program.send_signal(number)
        said, complained = program.communicate(timeout=WAIT_S)
    assert (program.returncode, said, complained) == (130, "", "scan_plan_execute: interrupted\n")


@pytest.mark.parametrize(
    ("corners", "reason"),
    [
        (("abc", *INSIDE[1:]), "invalid millimetres value: 'abc'"),
        (("300", "300", "3300", "3300"), "got 300; micrometres are divided by 1000"),
        (("nan", *INSIDE[1:]), "expected millimetres"),
        (INSIDE[:3], "required: Y2_MM"),
    ],
)
def test_corners_that_are_none_are_refused_before_the_scan(corners: tuple[str, ...], reason: str) -> None:
    with running(*corners) as program:
        said, complained = program.communicate(timeout=WAIT_S)
    assert (program.returncode, said) == (2, "")
    assert reason in complained
    assert "Traceback" not in complained


def test_the_examples_run_as_programs_and_end_in_order(client: Any) -> None:
    programs = [subprocess.Popen([sys.executable, str(EXAMPLES / f"minimal_{name}.py")]) for name in ("scanner", "arm")]
    try:
        scanned = client.call(Trigger, "scan", Trigger.Request(), WAIT_S)
        assert (scanned.success, scanned.message) == (
            True,
            "scanning 32 B-scans once a trainer subscribes to bscan and bscan_pose",
        )
        assert client.call(Trigger, "execute", Trigger.Request(), WAIT_S).message == "there is no plan"
        for program in programs:
            program.send_signal(signal.SIGINT)
        assert [program.wait(WAIT_S) for program in programs] == [0, 0]
    finally:
        for program in programs:
            if program.poll() is None:
                program.kill()
                program.wait()
