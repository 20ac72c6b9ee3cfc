"""For all tests: a graph of its own for each process, under rclpy and the embedded runtime alike; no deadlines."""

from __future__ import annotations

import os
import re
import socket
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from octn_ros import embedded
from octn_ros.openmp import wait_passively

# Time is measured in benchmarks; on a busy machine a deadline would fail a test that is right.
settings.register_profile("octn", deadline=None)
settings.load_profile("octn")

WARM_UP_S = 60.0  # at most: numba compiles all kernels anew after a change of them


def _own_graph() -> None:
    """Take a port that is free, and a domain that other test processes hardly have: before rclpy is imported."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    os.environ["OCTN_RENDEZVOUS_PORT"] = str(port)
    os.environ["ROS_DOMAIN_ID"] = str(1 + port % 100)  # DDS turns higher domains into ports that Linux may hand out
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


wait_passively()  # as the programs do: threads that spin take five times as long on a busy machine
if "OCTN_RENDEZVOUS_PORT" not in os.environ or "PYTEST_XDIST_WORKER" in os.environ:
    _own_graph()  # what a process of pytest-xdist finds in its environment is the graph of the one that started it
embedded.install()  # from here on the tests may import rclpy and the message packages


def _own_home(folder: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("ROS_HOME", str(folder / f"ros_home_{uuid.uuid4().hex}"))
        yield


@pytest.fixture(scope="module", autouse=True)
def _ros_home_of_module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No node finds what another one has kept, in the user's home least of all."""
    yield from _own_home(tmp_path_factory.getbasetemp())


@pytest.fixture(autouse=True)
def _ros_home_of_test(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    yield from _own_home(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="session", autouse=True)
def _no_kernel_outlives_the_tests() -> Iterator[None]:
    """Python aborts where it ends under a thread that still compiles, as those do that warm a node's kernels up."""
    yield
    for thread in threading.enumerate():
        if type(thread).__name__ == "_WorkerThread":
            thread.join(WARM_UP_S)


@pytest.fixture
def ros() -> Iterator[None]:
    """rclpy, initialised for one test."""
    import rclpy

    rclpy.init(args=[])
    try:
        yield
    finally:
        rclpy.try_shutdown()


@pytest.fixture
def client(ros: None) -> Iterator[Any]:
    """A client of the graph."""
    from octn_ros.nodes.client import GraphClient

    with GraphClient() as graph:
        yield graph


class PlannerStandIn:
    """Publishes plans, what it says of them and signs of life from another node, as the planner does."""

    def __init__(self, node: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseArray
        from sensor_msgs.msg import PointCloud2

        from octn_ros.nodes import diagnostics, qos

        self.node, self.lives, self._stands = node, True, ""
        self.waypoints = node.create_publisher(PoseArray, "waypoints", qos.LATCHED)
        self.tool_path = node.create_publisher(PointCloud2, "tool_path", qos.LATCHED)
        self.status = node.create_publisher(DiagnosticArray, "plan_status", qos.LATCHED)
        self._life = node.create_publisher(DiagnosticArray, diagnostics.TOPIC, qos.STREAM)
        self._timer = node.create_timer(0.05, self._live)

    def plan(self, stamp_ns: int, poses: Any, *, frame: str = "tool0", speed_m_s: float = 0.01, **said: str) -> None:
        """Publish a plan whose laser is on at each waypoint, and a status that differs by what is `said`."""
        import numpy as np

        from octn_ros.nodes import conversions

        zeros, ones = np.zeros(len(poses)), np.ones(len(poses))
        rows = conversions.tool_path(poses, zeros, ones, np.full(len(poses), speed_m_s), zeros, ones)
        tool_path = conversions.to_cloud(rows, stamp_ns, frame)
        self.tool_path.publish(tool_path)
        self.waypoints.publish(conversions.to_pose_array(poses, stamp_ns, frame))
        named = conversions.plan_hash(tool_path) if len(poses) else ""
        self.say(**{"scan": str(stamp_ns), "plan_hash": named, **said})

    def say(self, scan: str, plan_hash: str, **said: str) -> None:
        """Publish a status; what is not said is as of a plan that stands."""
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        values = {"state": "planned", "stamp_ns": scan, "field_hash": "ab12" * 4, "plan_hash": plan_hash, **said}
        values["node"] = self.node.get_fully_qualified_name()
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        self._stands = plan_hash
        self.status.publish(DiagnosticArray(status=[DiagnosticStatus(name="planner: plan_status", values=pairs)]))

    def leave(self) -> None:
        """Leave the graph."""
        self.node.destroy_timer(self._timer)
        for publisher in (self.waypoints, self.tool_path, self.status, self._life):
            self.node.destroy_publisher(publisher)

    def _live(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        if self.lives:
            stands = [KeyValue(key="plan_hash", value=self._stands)]
            name = f"{self.node.get_fully_qualified_name()}: state"
            self._life.publish(DiagnosticArray(status=[DiagnosticStatus(name=name, values=stands)]))


@pytest.fixture
def planner_stand_in(client: Any) -> Callable[[], PlannerStandIn]:
    """Make a planner's stand-in of the client's node."""
    return lambda: PlannerStandIn(client.node)


@pytest.fixture
def spin(ros: None) -> Iterator[Callable[..., Any]]:
    """Make nodes with parameters, and spin them until the test ends."""
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.parameter import Parameter

    from octn_ros.nodes.background import BackgroundSpin

    executor = MultiThreadedExecutor(num_threads=4)
    background = BackgroundSpin(executor, "nodes")
    nodes: list[Any] = []

    def make(kind: Any, **parameters: Any) -> Any:
        """`search__newton_steps=3` sets `search.newton_steps`."""
        node = kind(
            parameter_overrides=[Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
        )
        nodes.append(node)
        executor.add_node(node)
        return node

    yield make
    background.stop()
    for node in nodes:
        executor.remove_node(node)
        node.destroy_node()
    executor.shutdown()
    assert background.fault is None


def _shell_blocks(page: Path) -> list[tuple[str, str]]:
    text = page.read_text(encoding="utf-8")
    return re.findall(r"(?:<!-- ([^>]*) -->\n)?```sh\n(.*?)```", text, re.DOTALL)


def _shell_commands(block: str) -> list[str]:
    found: list[str] = []
    for line in block.splitlines():
        quotes = found and (found[-1].count('"') - found[-1].count('\\"')) % 2
        if quotes or (found and found[-1].endswith("\\")):
            found[-1] = found[-1].removesuffix("\\") + "\n" * bool(quotes) + line
        elif line.strip():
            found.append(line)
    return found


@pytest.fixture(scope="session")
def shell_blocks() -> Callable[[Path], list[tuple[str, str]]]:
    """(what its mark says, text) of each shell block of a page."""
    return _shell_blocks


@pytest.fixture(scope="session")
def shell_commands() -> Callable[[str], list[str]]:
    """The commands of a block, lines that belong together joined, empty ones left out."""
    return _shell_commands
