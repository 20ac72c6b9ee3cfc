"""Nodes in processes of their own, as `ros2 run` and `octn run` start them."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

EXIT_TIMEOUT_S = 30.0  # 2 s are promised, of a machine that does nothing else


class NodeProcess:
    """A node's process, or another program's."""

    def __init__(self, *command: str) -> None:
        self.popen = subprocess.Popen([sys.executable, *command])

    def kill(self) -> None:
        """End it as the system does where memory runs out: at once, without a word to the graph."""
        self.popen.kill()
        self.popen.wait()

    def end(self, signal_number: int = signal.SIGINT) -> None:
        """Interrupt it and see it end in order."""
        self.popen.send_signal(signal_number)
        began = time.monotonic()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.popen.wait(EXIT_TIMEOUT_S)
        assert self.popen.returncode == 0, f"exit code {self.popen.returncode} after {time.monotonic() - began:.1f} s"


@pytest.fixture
def launch() -> Iterator[Callable[..., NodeProcess]]:
    """Start a node with parameters, `launch("planner", "device:=cpu")`; none outlives the test."""
    started: list[NodeProcess] = []

    def run(node: str, *assignments: str) -> NodeProcess:
        given = [part for assignment in assignments for part in ("-p", assignment)]
        return program("-m", f"octn_ros.nodes.{node}", "--ros-args", *given)

    def program(*command: str) -> NodeProcess:
        started.append(NodeProcess(*command))
        return started[-1]

    run.program = program  # type: ignore[attr-defined]
    yield run
    for process in started:
        if process.popen.poll() is None:
            process.kill()
