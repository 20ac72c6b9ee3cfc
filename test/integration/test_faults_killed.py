"""Nodes that are killed and started again: what stands stays, and what is latched comes back."""

from __future__ import annotations

import dataclasses
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from nav_msgs.srv import GetPlan, LoadMap
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from octn_ros import embedded
from octn_ros.nodes import qos, status
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import Volume, save_volume

START_S, FIT_S, ANSWER_S = 180.0, 180.0, 120.0
SHAPE = (24, 64, 64)
SMALL_FIT = ("fit.steps:=100", "fit.batch:=4096", "fit.time_budget_s:=0.0", "fit.field.grid.log2_table_size:=15")
SIMULATOR = (
    f"phantom.shape:={list(SHAPE)}", "phantom.surface:=tilted", "bscan_period_s:=0.001", "time_factor:=1.0",
)  # fmt: skip
SLOW = "speed_m_s:=0.0001"  # of the laser: a raster takes half a minute
SILENCE_S = 5.0
LOST_S = 2.0 if embedded.install() else SILENCE_S + 2.0  # DDS takes ten seconds to miss a node that was killed
OCT = "oct_optical_frame"


class Graph:
    """Trainer, planner and query in processes of their own, and a client with what it hears."""

    def __init__(self, launch: Callable[..., Any], client: Any, folder: Path) -> None:
        self.launch, self.client, self.folder = launch, client, folder
        self.progress = client.watch(DiagnosticArray, "fit_progress", qos.REPORTS)  # a restarted trainer speaks early
        self.planned = client.watch(DiagnosticArray, "plan_status")
        self.health = client.watch(DiagnosticArray, "/diagnostics", qos.STREAM)
        self.field = client.watch(CompressedImage, "field")
        self.waypoints = client.watch(PoseArray, "waypoints")
        self.nodes = {name: self.start(name) for name in ("trainer", "planner", "query")}

    def start(self, name: str) -> Any:
        given: tuple[str, ...] = ("device:=cpu",) if name != "simulator" else SIMULATOR
        if name == "planner":
            given += (SLOW,)
        if name == "trainer":
            given += (f"data_root:={self.folder}", f"bscan_count:={SHAPE[0]}", "spacing_um:=[28.0, 14.59, 14.0]")
            given += (f"field_path:={self.folder / 'kept.zip'}", *SMALL_FIT)
        return self.launch(name, *given)

    def restart(self, name: str) -> int:
        """Kill a node and start it again; return how many reports of plans came before."""
        self.nodes[name].kill()
        heard = len(self.planned.messages)
        self.nodes[name] = self.start(name)
        return heard

    def wait_alone(self, topic: str) -> None:
        """Wait until only one node publishes a topic: DDS takes ten seconds to miss one that was killed.

        Until then a service of that node seems to be there, and a request to it may never be answered.
        """
        self.client.wait_for(lambda: self.client.node.count_publishers(topic) == 1, START_S, f"one {topic}")

    def load(self, name: str) -> None:
        answer = self.client.call(LoadMap, "load_cscan", LoadMap.Request(map_url=name), START_S)
        assert answer.result == LoadMap.Response.RESULT_SUCCESS

    def fitted(self, name: str) -> str:
        """Load a C-scan, wait until the planner has the field fitted to it, and return that field's hash."""
        before = len(self.progress.messages)
        self.load(name)
        done = self.progress.wait(FIT_S, lambda message: values(message).get("state") == "done", after=before)
        known = values(done)["field_hash"]
        self.planned.wait(ANSWER_S, lambda message: values(message).get("field_hash") == known)
        return known

    def ask(self, service: str, goal_m: tuple[float, float] = (6e-4, 5e-4)) -> Any:
        """Ask planner or query for a path with one corner, or end, given."""
        request = GetPlan.Request(tolerance=5e-5)
        for pose, place in ((request.start, (2e-4, 1.5e-4)), (request.goal, goal_m)):
            pose.header.frame_id = OCT
            pose.pose.position.x, pose.pose.position.y = place
        return self.client.call(GetPlan, service, request, ANSWER_S).plan

    def report(self, node: str, accept: Callable[[dict[str, str]], bool], after: int = 0) -> dict[str, str]:
        """Return the values of a report on a node's health."""

        def fits(message: Any) -> bool:
            return node in message.status[0].name and accept(values(message))

        return values(self.health.wait(START_S, fits, after=after))


def values(message: Any) -> dict[str, str]:
    return status.read(message)[2]


@pytest.fixture(scope="module")
def volume() -> Volume:
    return make_phantom(PhantomConfig(shape=SHAPE, surface="tilted")).volume


@pytest.fixture
def graph(launch: Callable[..., Any], client: Any, tmp_path: Path, volume: Volume) -> Graph:
    save_volume(tmp_path / "first.nii", volume)
    save_volume(tmp_path / "second.nii", dataclasses.replace(volume, array=volume.array[:, :, ::-1].copy()))
    return Graph(launch, client, tmp_path)


@pytest.mark.slow
def test_the_planner_outlives_a_trainer_that_is_killed_in_a_fit(graph: Graph) -> None:
    known = graph.fitted("first.nii")
    endless = Parameter("fit.steps", value=10_000_000).to_parameter_msg()
    asked = SetParameters.Request(parameters=[endless])
    assert graph.client.call(SetParameters, "trainer/set_parameters", asked, ANSWER_S).results[0].successful
    assert graph.client.call(Trigger, "refit", Trigger.Request(), ANSWER_S).success
    before = len(graph.progress.messages)
    graph.progress.wait(FIT_S, lambda message: "loss" in values(message), after=before)
    graph.nodes["trainer"].kill()

    heard = len(graph.health.messages)
    first = graph.report("planner", lambda told: told.get("field_hash") == known, after=heard)
    assert graph.ask("plan_raster").poses, "the planner has the last field"
    planned = graph.planned.wait(ANSWER_S, lambda message: values(message).get("state") == "planned")
    assert values(planned)["field_hash"] == known
    age_s = float(first["field_age_s"])
    graph.report("planner", lambda told: float(told["field_age_s"]) > age_s + 1.0, after=heard)

    graph.nodes["trainer"] = graph.start("trainer")
    restored = graph.progress.wait(START_S, lambda message: values(message).get("state") == "restored")
    assert values(restored)["field_hash"] == known
    graph.wait_alone("fit_progress")
    assert graph.fitted("second.nii") != known, "a new scan works"
    assert graph.ask("plan_raster").poses
    for node in graph.nodes.values():
        node.end()


@pytest.mark.slow
def test_a_plan_outlives_a_trainer_that_starts_again_with_the_same_field(graph: Graph) -> None:
    known = graph.fitted("first.nii")
    path = graph.ask("plan_raster")
    assert path.poses
    fields = len(graph.field.messages)
    graph.restart("trainer")
    graph.field.wait(START_S, after=fields)
    heard = len(graph.planned.messages)
    assert not graph.ask("plan_raster", goal_m=(1.0, 1.0)).poses
    refused = graph.planned.wait(ANSWER_S, after=heard)
    assert (values(refused)["state"], len(graph.planned.messages)) == ("refused", heard + 1), "no other report"
    told = graph.report("planner", lambda told: True, after=len(graph.health.messages))
    assert {"plan_stands": "true", "field_hash": known}.items() <= told.items()
    assert [len(message.poses) for message in graph.waypoints.messages] == [0, len(path.poses)]


@pytest.mark.slow
def test_planner_and_query_that_are_killed_get_the_latched_field_and_answer(graph: Graph) -> None:
    known = graph.fitted("first.nii")
    path = graph.ask("plan_raster")
    fields = len(graph.field.messages)

    heard = graph.restart("planner")
    graph.planned.wait(START_S, lambda message: values(message).get("field_hash") == known, after=heard)
    graph.wait_alone("plan_status")
    graph.waypoints.wait(ANSWER_S, lambda message: not message.poses, after=2)  # the plan of the killed one is over
    assert graph.ask("plan_raster").poses == path.poses

    told = len(graph.health.messages)
    graph.restart("query")
    graph.report("query", lambda told: told.get("field_hash") == known, after=told)
    graph.wait_alone("query_status")
    assert graph.ask("query_surface").poses
    assert len(graph.field.messages) == fields, "the trainer had nothing to publish again"
    for node in graph.nodes.values():
        node.end()


class Surgeon:
    """The simulator in a process beside the graph, a plan staged on its scan, and who fires it."""

    def __init__(self, graph: Graph) -> None:
        self.graph, self.client = graph, graph.client
        self.execution = self.client.watch(DiagnosticArray, "execution_status", qos.REPORTS)
        self.laser_on = self.client.watch(Bool, "laser_on")
        graph.start("simulator")
        self.execution.wait(START_S)
        self.client.wait_for(lambda: self.call("scan").success, START_S, "scan")
        graph.planned.wait(FIT_S, lambda message: values(message).get("field_kind") == "neural")
        self.plan()

    def call(self, service: str) -> Any:
        return self.client.call(Trigger, service, Trigger.Request(), START_S)

    def plan(self) -> None:
        """Have a plan made, and wait until it is staged."""
        told = len(self.execution.messages)
        assert self.graph.ask("plan_raster").poses
        self.execution.wait(ANSWER_S, lambda message: values(message)["state"] == "staged", after=told)

    def execute(self) -> Any:
        """Enable the laser and ask for the execution."""
        assert self.client.call(SetBool, "enable_laser", SetBool.Request(data=True), ANSWER_S).success
        return self.call("execute")

    def fire(self) -> None:
        """Execute, until the laser is on."""
        lit = len(self.laser_on.messages)
        answer = self.execute()
        assert answer.success, answer.message
        self.laser_on.wait(ANSWER_S, lambda message: message.data, after=lit)

    def aborted(self) -> tuple[str, float]:
        """Wait until the laser is off because of a fault; return why, and how long that took."""
        began = time.monotonic()
        end = self.execution.wait(ANSWER_S, lambda message: values(message)["state"] == "aborted")
        self.client.wait_for(lambda: self.laser_on.messages[-1].data is False, ANSWER_S, "laser_on: false")
        return status.read(end)[1], time.monotonic() - began


@pytest.mark.slow
def test_the_laser_is_off_when_the_planner_is_killed_in_an_execution(graph: Graph) -> None:
    surgeon = Surgeon(graph)
    surgeon.fire()
    graph.nodes["planner"].kill()
    reason, seconds = surgeon.aborted()
    print(f"killed planner: laser off after {seconds:.2f} s: {reason}")
    assert seconds < LOST_S


@pytest.mark.slow
def test_the_laser_is_off_when_the_planner_hangs_in_an_execution(graph: Graph) -> None:
    surgeon = Surgeon(graph)
    surgeon.fire()
    planner = graph.nodes["planner"].popen
    planner.send_signal(signal.SIGSTOP)
    reason, seconds = surgeon.aborted()
    print(f"stopped planner: laser off after {seconds:.2f} s: {reason}")
    assert "sign of life" in reason
    assert SILENCE_S - 1.5 < seconds < SILENCE_S + 1.0, "counted from the last sign, a second before at most"
    assert "sign of life" in surgeon.execute().message
    planner.send_signal(signal.SIGCONT)
    surgeon.plan()
    surgeon.fire()


@pytest.mark.slow
def test_a_planner_started_again_beside_a_killed_one_is_obeyed_once_the_graph_has_forgotten_that(graph: Graph) -> None:
    surgeon = Surgeon(graph)
    heard, began, said = graph.restart("planner"), time.monotonic(), set()
    graph.planned.wait(START_S, lambda message: "field_hash" in values(message), after=heard)
    ready_s = time.monotonic() - began
    while not (answer := surgeon.execute()).success:
        assert time.monotonic() - began < START_S, answer.message
        said.add(answer.message)
        graph.ask("plan_raster")
        time.sleep(0.5)
    print(f"started again: a field after {ready_s:.1f} s, fired after {time.monotonic() - began:.1f} s; said: {said}")
    assert all("plan again" in words or "sign of life" in words for words in said), said
