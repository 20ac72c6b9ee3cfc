"""The exit code of a node that cannot start and of a demo that fails, whatever their threads are still at."""

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
