"""One run over the graph: scan, wait for the field, plan, execute; every figure is what the nodes published."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import octn_ros.nodes  # noqa: F401 - makes the message packages importable where ROS 2 is missing

# isort: split
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, PointCloud2

from octn_ros.demo.graph import DemoError, demo_graph
from octn_ros.demo.pictures import FitPoint
from octn_ros.demo.rectangle import centred_rectangle
from octn_ros.demo.services import ANSWER_S, enable_laser, plan_rectangle, publish_slice, trigger
from octn_ros.demo.source import ScanSource
from octn_ros.field import Field, field_hash, loads_field
from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.client import GraphClient, Watch
from octn_ros.training.progress import PREPARING
from octn_ros.volume import VolumeGeometry

# How long is waited for what, in seconds: limits for what hangs, as in `services`.
SCAN_S = 300.0
# Beyond the time budget: kernels are compiled before it begins on a machine's first run, for minutes where others work
# too; the last step and the evaluation come after it.
FIT_GRACE_S = 600.0
EXECUTION_S = 600.0
LINE_SPACING_M = 50e-6
TIME_FACTOR = 20.0  # the mock arm's clock runs so much faster: a raster of 3 x 3 mm takes most of a minute at 5 mm/s
# Of the simulator in both demos. All nodes share one process, so what holds it up, such as a busy machine, holds up
# planner, arm and laser alike: the half second that a laser beside a person is allowed would only end a show.
ONE_PROCESS: Mapping[str, Any] = {
    "time_factor": TIME_FACTOR,
    "interlock.longest_stall_s": 10.0,
    "interlock.planner_silence_s": 15.0,
}

Show = Callable[[str, float, str], None]


@dataclass(frozen=True)
class SessionRecord:
    """What came over the graph in one run.

    Attributes:
        field: the field as received, float16 on the way.
        field_hash: identity of its bytes.
        fit: the trainer's last report, values by name.
        history: the trainer's reports on the way.
        plan: the planner's report.
        waypoints_oct: poses of the laser focus in the OCT frame [N, 4, 4].
        tool_path: the plan in the end-effector frame, structured array [N] of `conversions.TOOL_PATH`.
        execution: the simulator's last report.
        seconds: duration of each part.
    """

    field: Field
    field_hash: str
    fit: dict[str, str]
    history: tuple[FitPoint, ...]
    plan: dict[str, str]
    waypoints_oct: NDArray[np.float64]
    tool_path: NDArray[np.void]
    execution: dict[str, str]
    seconds: dict[str, float]


@dataclass
class Stopwatch:
    """Durations of named parts of a run, in seconds."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Measure what is done inside; parts of one name add up."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def run_session(
    source: ScanSource, fit_parameters: Mapping[str, Any], show: Show, record: Path | None = None
) -> SessionRecord:
    """Start the nodes, work them through one scan from end to end, and stop them.

    Args:
        source: what the simulator scans.
        fit_parameters: of the trainer, such as `fit.time_budget_s`.
        show: told what is going on: title, fraction of it that is done, remark. Called from several threads.
        record: a file for a recording of the graph, None for none.

    Raises:
        DemoError: a node refused, failed or did not answer in time.
        OctnError: a node cannot start with its parameters.
    """
    watch = Stopwatch()
    with ExitStack() as stack:
        with watch.part("start"):
            show("starting the nodes", 0.0, "")
            client = stack.enter_context(demo_graph(_parameters(source, fit_parameters), record))
            ears = Ears(client)
        with watch.part("scan"):
            show("scanning", 0.0, "")
            _scan(client, ears)
        with watch.part("fit"):
            show(*PREPARING)
            client.node.create_subscription(
                DiagnosticArray, "fit_progress", lambda message: _show_fit(message, show), qos.STREAM
            )
            message = _wait_field(ears, fit_parameters)
        data = conversions.field_data(message)
        identity = field_hash(data)
        with watch.part("plan"):
            show("planning", 0.0, "")
            plan = _plan(client, ears, source.volume.geometry, identity)
            waypoints_oct, tool_path = _waypoints(ears, plan)
            if record is not None:  # nothing else of the demo asks for them, and a viewer has a place for each
                middle = (source.volume.geometry.shape[0] - 1) / 2
                publish_slice(client, f"bscan:{middle:g}")
                trigger(client, "query_band")
        with watch.part("execute"):
            execution = _execute(client, ears, show)
        return SessionRecord(
            field=loads_field(data),
            field_hash=identity,
            fit=_last(ears.fit_progress, ("done",)),
            history=_history(ears),
            plan=plan,
            waypoints_oct=waypoints_oct,
            tool_path=tool_path,
            execution=execution,
            seconds=watch.seconds,
        )


class Ears:
    """The topics that the demo listens to, from before anything is asked."""

    def __init__(self, client: GraphClient) -> None:
        self.fit_progress = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
        self.field = client.watch(CompressedImage, "field", keep=1)
        self.plan_status = client.watch(DiagnosticArray, "plan_status")
        self.waypoints = client.watch(PoseArray, "waypoints")
        self.waypoints_oct = client.watch(PoseArray, "waypoints_oct")
        self.tool_path = client.watch(PointCloud2, "tool_path")
        self.execution_status = client.watch(DiagnosticArray, "execution_status")
        # Not latched: what is said before the two have met would be lost.
        self.fit_progress.wait_matched(ANSWER_S)


def _parameters(source: ScanSource, fit_parameters: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    return {
        "simulator": {**source.simulator_parameters, **ONE_PROCESS, "audit_path": ""},
        "trainer": {**source.trainer_parameters, **fit_parameters},
    }


def _scan(client: GraphClient, ears: Ears) -> None:
    trigger(client, "scan")
    values = _wait_state(ears.fit_progress, ("fitting",), ("refused", "failed"), SCAN_S)
    if "stamp_ns" not in values:
        raise DemoError(f"expected the trainer to name the scan it fits, got {values}")


def _wait_field(ears: Ears, fit_parameters: Mapping[str, Any]) -> CompressedImage:
    budget_s = float(fit_parameters["fit.time_budget_s"])
    values = _wait_state(ears.fit_progress, ("done",), ("refused", "failed", "cancelled"), budget_s + FIT_GRACE_S)
    # The field through the voxels came first, on the same topic and of the same stamp.
    return ears.field.wait(
        ANSWER_S, lambda message: field_hash(conversions.field_data(message)) == values["field_hash"]
    )


def _plan(client: GraphClient, ears: Ears, geometry: VolumeGeometry, field: str) -> dict[str, str]:
    """Ask for the default rectangle on the field of that hash; return the planner's report on it."""

    def of_this_field(message: DiagnosticArray) -> bool:
        return status.read(message)[2].get("field_hash") == field

    ears.plan_status.wait(ANSWER_S, of_this_field)  # "ready": the planner has the field too
    corners = centred_rectangle(geometry)
    return plan_rectangle(client, ears.plan_status, corners, geometry.frame, LINE_SPACING_M, field)


def _waypoints(ears: Ears, plan: dict[str, str]) -> tuple[NDArray[np.float64], NDArray[np.void]]:
    """Return the poses in the OCT frame and the tool path of the plan, held against each other."""
    count, stamp_ns = int(plan["waypoints"]), int(plan["stamp_ns"])

    def of_plan(message: PoseArray | PointCloud2) -> bool:
        size = len(message.poses) if isinstance(message, PoseArray) else message.width
        return size == count and conversions.stamp_to_ns(message.header.stamp) == stamp_ns

    ears.waypoints.wait(ANSWER_S, of_plan)
    poses = conversions.poses_to_matrices(ears.waypoints_oct.wait(ANSWER_S, of_plan).poses)
    return poses, conversions.cloud_to_tool_path(ears.tool_path.wait(ANSWER_S, of_plan))


def _execute(client: GraphClient, ears: Ears, show: Show) -> dict[str, str]:
    show("executing", 0.0, "")
    _wait_state(ears.execution_status, ("staged",), (), ANSWER_S)
    client.node.create_subscription(
        DiagnosticArray, "execution_status", lambda message: _show_execution(message, show), qos.LATCHED
    )
    enable_laser(client)
    trigger(client, "execute")
    return _wait_state(ears.execution_status, ("done",), ("aborted",), EXECUTION_S)


def _wait_state(
    topic: Watch[DiagnosticArray], good: tuple[str, ...], bad: tuple[str, ...], timeout_s: float
) -> dict[str, str]:
    """Return the values of the first report in one of the good states.

    Raises:
        DemoError: one in a bad state came first.
    """
    _, message, values = status.read(
        topic.wait(timeout_s, lambda report: status.read(report)[2].get("state") in (*good, *bad))
    )
    if values["state"] in bad:
        raise DemoError(message)
    return values


def _last(topic: Watch[DiagnosticArray], states: tuple[str, ...]) -> dict[str, str]:
    return next(v for _, _, v in map(status.read, reversed(topic.messages)) if v.get("state") in states)


def _history(ears: Ears) -> tuple[FitPoint, ...]:
    reports = (status.read(message)[2] for message in ears.fit_progress.messages)
    return tuple(
        FitPoint(float(v["seconds"]), float(v["loss"]), float(v["psnr_db"]), v["stage"])
        for v in reports
        if "stage" in v
    )


def _show_fit(message: DiagnosticArray, show: Show) -> None:
    values = status.read(message)[2]
    if "stage" in values:
        remark = f"{values['stage']}, step {values['step']}, {float(values['psnr_db']):.1f} dB"
        show("fitting the field", float(values["fraction"]), remark)


def _show_execution(message: DiagnosticArray, show: Show) -> None:
    values = status.read(message)[2]
    if int(values["waypoints"]):
        show("executing", int(values["passed"]) / int(values["waypoints"]), f"{values['shots']} shots")
