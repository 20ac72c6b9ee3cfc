"""For all tests: a graph of its own for each process, under rclpy and the embedded runtime alike; no deadlines."""

from __future__ import annotations

import os
import socket
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from octn_ros import embedded

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


if "OCTN_RENDEZVOUS_PORT" not in os.environ:
    _own_graph()
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
