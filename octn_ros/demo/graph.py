"""The four nodes of the demo in this process, in a ROS graph of their own."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import octn_ros.nodes  # noqa: F401 - makes rclpy importable where ROS 2 is missing

# isort: split
import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from octn_ros import embedded
from octn_ros.demo.recording import Recording
from octn_ros.errors import OctnError
from octn_ros.nodes.background import BackgroundSpin
from octn_ros.nodes.client import GraphClient
from octn_ros.nodes.planner import Planner
from octn_ros.nodes.query import Query
from octn_ros.nodes.simulator import Simulator
from octn_ros.nodes.trainer import Trainer

NODES: dict[str, Callable[..., Node]] = {
    "simulator": Simulator,
    "trainer": Trainer,
    "planner": Planner,
    "query": Query,
}
THREADS = 6  # one for each node's slowest callback, and two for whatever else is asked meanwhile
RENDEZVOUS_PORT = "OCTN_RENDEZVOUS_PORT"
CLOSE_WAIT_S = 5.0
_BUSY = "is the machine busy with other programs? end them and run it again, or ask for less with --quick"


class DemoError(OctnError):
    """The graph did not do what it was asked to."""


@contextmanager
def demo_graph(parameters: Mapping[str, Mapping[str, Any]], record: Path | None = None) -> Iterator[GraphClient]:
    """Run the nodes on an executor in a background thread; yield a client of their graph, at the end stop them all.

    The graph has a domain of its own, so that it does not meet another one by accident. Waits that run out of time
    become errors here, with the fault of the nodes that caused them if there was one.

    Args:
        parameters: of each node, by the node's name.
        record: a file for a recording of all that the nodes publish, MCAP; None for none.

    Raises:
        OctnError: a node cannot start with its parameters.
        DemoError: the graph did not answer in time.
        RecordingError: the recording cannot be made.
    """
    nodes: list[Node] = []
    spin = recording = None
    with _private_domain() as domain_id:
        # Warnings and errors of the nodes stay visible beside the progress bar, their chatter does not. Ctrl-C is for
        # the thread that waits, which then takes the graph down in order.
        rclpy.init(
            args=["octn", "--ros-args", "--log-level", "warn"],
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        executor = MultiThreadedExecutor(num_threads=THREADS)
        try:
            for name, make_node in NODES.items():
                overrides = [Parameter(key, value=_value(value)) for key, value in parameters.get(name, {}).items()]
                nodes.append(make_node(parameter_overrides=overrides))
                executor.add_node(nodes[-1])
            spin = BackgroundSpin(executor, "demo graph")
            if record is not None:
                recording = Recording(nodes, record)
            with GraphClient("demo") as client:
                yield client
        except TimeoutError as error:
            because = f"the nodes have stopped: {spin.fault!r}" if spin and spin.fault else _BUSY
            raise DemoError(f"{error}; {because}") from error
        finally:
            if spin is not None:
                spin.stop(CLOSE_WAIT_S)
            executor.shutdown(timeout_sec=CLOSE_WAIT_S)
            for node in nodes:
                node.destroy_node()
            try:
                if recording is not None:
                    recording.close()
            finally:
                rclpy.try_shutdown()


@contextmanager
def _private_domain() -> Iterator[int]:
    """Yield a ROS domain, and give the embedded runtime a port, that nobody else is likely to use."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    before = os.environ.get(RENDEZVOUS_PORT)
    if embedded.install():
        os.environ[RENDEZVOUS_PORT] = str(port)
    try:
        yield 1 + port % 100  # DDS has ports for the domains up to 101 everywhere; 0 is everybody's
    finally:
        if before is None:
            os.environ.pop(RENDEZVOUS_PORT, None)
        else:
            os.environ[RENDEZVOUS_PORT] = before


def _value(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
