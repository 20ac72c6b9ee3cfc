"""The exit code of a node that cannot start, whatever its threads are still at."""

from __future__ import annotations

import subprocess
import sys

import pytest

EXIT_SEC = 60.0
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
