"""The exit code of a node that cannot start or gets a signal, and of a demo that fails, whatever their threads do."""

from __future__ import annotations

import subprocess
import sys

import pytest

EXIT_SEC = 60.0
DEMO = """
import sys
from octn_ros import cli
from octn_ros.commands.demo import DemoCommand
from octn_ros.errors import OctnError

def run(command):
    import octn_ros.nodes
    from octn_ros.nodes.worker import run_aside
    import torch
    grid = torch.zeros(1 << 20)
    def work():
        while True:
            grid.sin_()
    run_aside(work, "computes for ever")
    raise {error}

DemoCommand.run = run
sys.argv = ["octn", "demo"]
sys.exit(cli.main())
"""
PROGRAM = """
import sys, threading
from octn_ros.nodes import process
from octn_ros.nodes.worker import run_aside
from octn_ros.errors import OctnError

def make_node():
    run_aside(threading.Event().wait, "works for ever")
    raise {error}

sys.exit(process.run(make_node, []))
"""
SIGNALLED = """
import signal, sys, threading
from octn_ros.nodes import process
from rclpy.node import Node

start = threading.Thread.start

def signalled(moment):
    if moment == "{moment}":
        for name in "{names}".split():
            signal.raise_signal(signal.Signals[name])

def start_signalled(thread):
    start(thread)
    if thread.name.startswith("ThreadPoolExecutor"):
        signalled("the start of the executor's first thread")

def make_node():
    threading.Thread.start = start_signalled
    node = Node("signalled")
    node.create_timer(0.001, lambda: None)
    signalled("the making of the node")
    return node

sys.exit(process.run(make_node, []))
"""


@pytest.mark.parametrize("names", ["SIGINT", "SIGINT SIGINT", "SIGTERM", "SIGTERM SIGINT"])
@pytest.mark.parametrize("moment", ["the making of the node", "the start of the executor's first thread"])
def test_a_signal_ends_a_node_in_order_whenever_it_comes(moment: str, names: str) -> None:
    command = [sys.executable, "-c", SIGNALLED.format(moment=moment, names=names)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=EXIT_SEC, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("error", "code", "told"), [("OctnError('no such scan')", 2, "no such scan"), ("KeyError('bug')", 1, "Traceback")]
)
def test_a_node_that_cannot_start_says_so_by_its_code_though_a_thread_works(error: str, code: int, told: str) -> None:
    command = [sys.executable, "-c", PROGRAM.format(error=error)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=EXIT_SEC, check=False)
    assert ended.returncode == code, ended.stderr
    assert told in ended.stderr


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [("OctnError('no field')", 2, "octn demo: error: no field"), ("KeyboardInterrupt", 130, "octn demo: interrupted")],
)
def test_a_demo_that_fails_while_a_thread_computes_ends_in_order(error: str, code: int, told: str) -> None:
    command = [sys.executable, "-c", DEMO.format(error=error)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=EXIT_SEC, check=False)
    assert ended.returncode == code, ended.stderr
    assert ended.stderr.splitlines() == [told]
