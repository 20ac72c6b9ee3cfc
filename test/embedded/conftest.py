"""Everything here runs on the embedded runtime, each test in a context of its own, out of reach of other runs."""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from octn_ros import embedded

ROOT = Path(__file__).parents[2]
PROGRAMS = Path(__file__).parent / "programs"
WAIT_SEC = 120.0  # for what takes milliseconds when the machine is idle
STEP_SEC = 0.05

GENUINE = not embedded.install()  # asked of the hook itself: another folder's tests may have installed it already


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if GENUINE:
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.skip(reason="a genuine rclpy is installed: the embedded one is not in use"))


def own_graph() -> dict[str, str]:
    """Environment variables that keep a group of processes among themselves."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return {"OCTN_RENDEZVOUS_PORT": str(port), "ROS_DOMAIN_ID": str(random.randrange(1, 230))}


@pytest.fixture(autouse=True)
def graph(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    variables = own_graph()
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    return variables


@pytest.fixture
def init(graph: dict[str, str]) -> Iterator[Callable[..., None]]:
    """rclpy.init with ROS arguments; shut down afterwards."""
    import rclpy

    def start(*arguments: str) -> None:
        rclpy.init(args=["program", "--ros-args", *arguments])

    yield start
    rclpy.try_shutdown()


@pytest.fixture
def nodes(init: Callable[..., None]) -> Iterator[Callable[..., object]]:
    """Makes nodes, and initializes rclpy where the test has not done so; nodes are destroyed afterwards."""
    import rclpy
    from rclpy.node import Node

    made = []

    def make(name: str, **kwargs: object) -> Node:
        if not rclpy.ok():
            init()
        made.append(Node(name, **kwargs))
        return made[-1]

    yield make
    for node in made:
        node.destroy_node()


@pytest.fixture
def spin_until() -> Callable[..., None]:
    """Spins nodes until something is true; fails with the name of what was waited for."""
    from rclpy.executors import SingleThreadedExecutor

    def spin(condition: Callable[[], object], *given: object, executor: object = None) -> None:
        executor = executor or SingleThreadedExecutor()
        for node in given:
            executor.add_node(node)
        end = time.monotonic() + WAIT_SEC
        while not condition():
            assert time.monotonic() < end, f"waited {WAIT_SEC} s in vain"
            executor.spin_once(timeout_sec=STEP_SEC)
        for node in given:
            executor.remove_node(node)

    return spin


@pytest.fixture
def program(graph: dict[str, str]) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a program of the folder `programs`; what still runs is killed afterwards."""
    started: list[subprocess.Popen[str]] = []

    def start(name: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-W", "error", str(PROGRAMS / name), *arguments]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()
