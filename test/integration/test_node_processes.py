"""Each node in a process of its own, as `ros2 run` and `octn run` start them."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from nav_msgs.srv import GetPlan, LoadMap
from std_srvs.srv import SetBool, Trigger

from octn_ros.nodes import qos, status
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import save_volume

START_TIMEOUT_S = 180.0
FIT_TIMEOUT_S = 180.0
ANSWER_TIMEOUT_S = 120.0
EXIT_TIMEOUT_S = 30.0  # 2 s are promised, of a machine that does nothing else

EXAMPLE = Path(__file__).parents[2] / "examples" / "scan_plan_execute.py"
SHAPE = (24, 64, 64)
SMALL_FIT = ("fit.steps:=150", "fit.batch:=4096", "fit.time_budget_s:=0.0", "fit.field.grid.log2_table_size:=15")
PARAMETERS = {
    "trainer": (f"bscan_count:={SHAPE[0]}", "spacing_um:=[28.0, 14.59, 14.0]", "device:=cpu", *SMALL_FIT),
    "query": ("device:=cpu",),
    "planner": ("device:=cpu",),
    "simulator": (f"phantom.shape:={list(SHAPE)}", "phantom.surface:=tilted", "time_factor:=50.0"),
}


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Start a node's process; none outlives the test."""
    processes = []

    def run(node: str, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"octn_ros.nodes.{node}", *arguments]
        processes.append(subprocess.Popen(command))
        return processes[-1]

    yield run
    for process in processes:
        if process.poll() is None:
            process.kill()
            process.wait()


def parameters(*assignments: str) -> list[str]:
    return ["--ros-args", *(part for assignment in assignments for part in ("-p", assignment))]


def end(process: subprocess.Popen[bytes], signal_number: int = signal.SIGINT) -> None:
    process.send_signal(signal_number)
    began = time.monotonic()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(EXIT_TIMEOUT_S)
    assert process.returncode == 0, f"exit code {process.returncode} after {time.monotonic() - began:.1f} s"


def values(message: Any) -> dict[str, str]:
    return status.read(message)[2]


def test_four_processes_from_scan_to_executed_shots(start: Callable[..., Any], client: Any) -> None:
    processes = [start(node, *parameters(*assignments)) for node, assignments in PARAMETERS.items()]
    plan_status = client.watch(DiagnosticArray, "plan_status")
    execution = client.watch(DiagnosticArray, "execution_status")
    execution.wait(START_TIMEOUT_S)
    fit_progress = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
    fit_progress.wait_matched(START_TIMEOUT_S)
    # The simulator refuses to scan until it has met the trainer.
    deadline = time.monotonic() + START_TIMEOUT_S
    while not client.call(Trigger, "scan", Trigger.Request(), START_TIMEOUT_S).success:
        assert time.monotonic() < deadline
    # Not the field through the voxels, which comes first: its plan would be withdrawn for the fitted one's sake.
    fitted = values(fit_progress.wait(FIT_TIMEOUT_S, lambda message: values(message).get("state") == "done"))
    plan_status.wait(FIT_TIMEOUT_S, lambda message: values(message).get("field_hash") == fitted["field_hash"])

    request = GetPlan.Request(tolerance=5e-5)
    request.start.header.frame_id = request.goal.header.frame_id = "oct_optical_frame"
    request.start.pose.position.x, request.start.pose.position.y = 2e-4, 1.5e-4
    request.goal.pose.position.x, request.goal.pose.position.y = 6e-4, 5e-4
    path = client.call(GetPlan, "plan_raster", request, ANSWER_TIMEOUT_S).plan
    assert path.poses
    # A late joiner gets what is latched.
    waypoints = client.watch(PoseArray, "waypoints").wait(ANSWER_TIMEOUT_S)
    assert [pose.pose for pose in path.poses] == list(waypoints.poses)

    execution.wait(ANSWER_TIMEOUT_S, lambda message: values(message)["state"] == "staged")
    client.call(SetBool, "enable_laser", SetBool.Request(data=True), ANSWER_TIMEOUT_S)
    answer = client.call(Trigger, "execute", Trigger.Request(), ANSWER_TIMEOUT_S)
    assert answer.success, answer.message
    done = execution.wait(ANSWER_TIMEOUT_S, lambda message: values(message)["state"] == "done")
    assert int(values(done)["shots"]) == len(path.poses)
    for process in processes:
        end(process)


def test_the_example_drives_the_graph(start: Callable[..., Any], client: Any) -> None:
    for node in ("trainer", "planner", "simulator"):
        start(node, *parameters(*PARAMETERS[node]))
    client.watch(DiagnosticArray, "execution_status").wait(START_TIMEOUT_S)
    client.watch(DiagnosticArray, "plan_status").wait_matched(START_TIMEOUT_S)
    client.watch(DiagnosticArray, "fit_progress", qos.STREAM).wait_matched(START_TIMEOUT_S)
    command = [sys.executable, "-W", "error", str(EXAMPLE), "0.2", "0.15", "0.6", "0.5"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=FIT_TIMEOUT_S, check=False)
    assert ended.returncode == 0, ended.stderr
    lines = ended.stdout.splitlines()
    assert lines[0].startswith(f"scan: scanning {SHAPE[0]} B-scans every 28 um")
    # 8 lines of 9 waypoints or more: they are spread along the surface, which is longer than the plane below it.
    count = int(lines[1].split()[1])
    assert 72 <= count <= 96
    assert lines[1].startswith(f"plan: {count} waypoints in tool0")
    assert lines[2:] == [f"execute: executing {count} waypoints", f"arm: done: {count} shots"]


def test_an_interrupt_ends_the_trainer_during_a_fit(start: Callable[..., Any], client: Any, tmp_path: Path) -> None:
    save_volume(tmp_path / "scan.nii.gz", make_phantom(PhantomConfig(shape=SHAPE)).volume)
    endless = ("fit.steps:=10000000", "fit.time_budget_s:=0.0", "device:=cpu", f"data_root:={tmp_path}")
    trainer = start("trainer", *parameters(*endless))
    progress = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
    request = LoadMap.Request(map_url=(tmp_path / "scan.nii.gz").as_uri())
    answer = client.call(LoadMap, "load_cscan", request, START_TIMEOUT_S)
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    progress.wait(FIT_TIMEOUT_S, lambda message: "loss" in values(message))
    end(trainer)


def test_an_interrupt_ends_a_node_that_still_compiles(
    start: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))  # nothing is compiled yet
    process = start("trainer", *parameters("device:=cpu"))
    deadline = time.monotonic() + START_TIMEOUT_S
    while not any(path.is_file() for path in tmp_path.rglob("*.nbi")):  # the first kernel is done, many are to come
        assert time.monotonic() < deadline
        time.sleep(0.05)
    end(process)


def test_a_terminated_node_ends_in_order(start: Callable[..., Any], client: Any) -> None:
    simulator = start("simulator", *parameters(*PARAMETERS["simulator"]))
    client.watch(DiagnosticArray, "execution_status").wait(START_TIMEOUT_S)
    end(simulator, signal.SIGTERM)


def test_more_interrupts_do_not_break_an_ordered_end(start: Callable[..., Any], client: Any) -> None:
    simulator = start("simulator", *parameters(*PARAMETERS["simulator"]))
    client.watch(DiagnosticArray, "execution_status").wait(START_TIMEOUT_S)
    deadline = time.monotonic() + EXIT_TIMEOUT_S
    while simulator.poll() is None:
        assert time.monotonic() < deadline
        simulator.send_signal(signal.SIGINT)
        time.sleep(0.01)
    assert simulator.returncode == 0


def test_what_a_node_cannot_start_with_ends_with_code_2_and_one_line() -> None:
    cases = [
        ("planner", parameters("calibration:=/nowhere/calibration.yaml"), "/nowhere/calibration.yaml"),
        ("planner", parameters("device:=abacus"), "abacus"),
        ("simulator", parameters("volume_file:=/nowhere/scan.nii"), "no such file"),
        ("trainer", parameters("fit.alpha:=1.5"), "fit.alpha"),
        ("trainer", ["--preset", "fast"], "got --preset fast"),
        ("query", ["-p", "preset:=fast"], "--ros-args -p NAME:=VALUE"),
        ("query", ["--ros-args", "--params-file", "/nowhere/octn.yaml"], "/nowhere/octn.yaml"),
        ("simulator", parameters("time_factor:=50"), "with a point, as 50.0"),
        ("trainer", parameters("spacing_um:=28"), "as '[28.0, 14.59, 14.0]'"),
    ]
    commands = [[sys.executable, "-m", f"octn_ros.nodes.{node}", *arguments] for node, arguments, _ in cases]
    # All at once: each takes seconds to load torch.
    started = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for command in commands]
    try:
        told = [process.communicate(timeout=START_TIMEOUT_S)[1] for process in started]
    finally:
        for process in started:  # those that hang; the others are gone
            process.kill()
            process.communicate()
    for process, words, (_, _, reason) in zip(started, told, cases, strict=True):
        assert process.returncode == 2, words
        assert reason in words
        assert "Traceback" not in words


def test_a_parameter_that_there_is_not_is_said_at_the_start() -> None:
    command = [sys.executable, "-m", "octn_ros.nodes.planner", *parameters("keepout:=/nowhere/keep_out.yaml")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        warned = next(line for line in process.stderr if "there is no parameter" in line)
    finally:
        process.kill()
        process.communicate()
    assert "keepout (did you mean keep_out?)" in warned


def test_the_namespace_can_be_changed(start: Callable[..., Any], client: Any) -> None:
    start("simulator", *parameters(*PARAMETERS["simulator"]), "-r", "__ns:=/theatre_2")
    client.watch(DiagnosticArray, "/theatre_2/execution_status").wait(START_TIMEOUT_S)
    assert client.call(Trigger, "/theatre_2/abort", Trigger.Request(), ANSWER_TIMEOUT_S).success
