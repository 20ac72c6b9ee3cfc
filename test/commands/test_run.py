"""`octn run`: the node's main gets the remaining arguments, and its exit code is the command's."""

import json
import subprocess
import sys
import types

import pytest

from octn_ros.cli import main
from octn_ros.commands.run import NODES


@pytest.fixture
def fake_node(monkeypatch):
    """Stand-ins for the nodes' modules that note their arguments."""
    seen = []

    def make(name, code):
        module = types.ModuleType(f"octn_ros.nodes.{name}")
        module.main = lambda args: seen.append((name, args)) or code
        monkeypatch.setitem(sys.modules, module.__name__, module)

    for name in NODES:
        make(name, 0)
    make("planner", 2)
    return seen


def test_the_rest_goes_to_the_node(fake_node):
    assert main(["run", "trainer", "--ros-args", "-r", "__ns:=/b", "-p", "preset:=fast", "--", "--json"]) == 0
    assert fake_node == [
        ("trainer", ["octn run trainer", "--ros-args", "-r", "__ns:=/b", "-p", "preset:=fast", "--", "--json"])
    ]


def test_the_exit_code_is_the_nodes(fake_node, capsys):
    assert main(["run", "--json", "planner"]) == 2
    assert json.loads(capsys.readouterr().out) == {"node": "planner", "arguments": [], "exit_code": 2}


def test_an_interrupt_while_the_node_is_imported_ends_it():
    """Also where the import loses the exception that an interrupt is, as some do."""
    lines = """
import importlib, os, signal, sys, time, types
def imported(name):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)
    except KeyboardInterrupt:
        pass
    return types.SimpleNamespace(main=lambda args: 0)
from octn_ros.cli import main
importlib.import_module = imported
sys.exit(main(["run", "trainer"]))
"""
    ended = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr) == (130, "octn run: interrupted\n")
