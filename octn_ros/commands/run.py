"""`octn run`: start one node of the graph in this process, with or without ROS 2 installed."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
from dataclasses import dataclass
from typing import Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal

NODES = ("trainer", "query", "planner", "simulator")


@dataclass(frozen=True)
class RunCommand:
    """Run one node until it is stopped.

    Attributes:
        node: one of NODES.
        rest: arguments for the node, `--ros-args ...`.
        json: print one JSON object when the node has ended.
    """

    node: str
    rest: tuple[str, ...] = ()
    json: bool = False

    def run(self) -> int:
        """Run the node's main and return its exit code, 0 if it names none."""
        # An interrupt as an exception can be lost inside an import, or come out as another error, and the node starts.
        before = signal.signal(signal.SIGINT, _leave)
        try:
            main = importlib.import_module(f"octn_ros.nodes.{self.node}").main
        finally:
            signal.signal(signal.SIGINT, before)
        code = int(main([f"octn run {self.node}", *self.rest]) or 0)
        if self.json:
            terminal.print_json({"node": self.node, "arguments": list(self.rest), "exit_code": code})
        return code


def _leave(number: int, _: object) -> None:
    """End the process at once, on a signal that comes before there is anything to end in order."""
    os.write(2, b"octn run: interrupted\n")
    os._exit(128 + number)


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser(
        "run",
        help="run one node",
        description="Run one node in this terminal; Ctrl-C ends it.",
        epilog="Example: octn run trainer --ros-args -r __ns:=/octn -p preset:=fast",
    )
    common.add_json(parser)
    parser.add_argument("node", choices=NODES, help="the node")
    parser.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="for the node: --ros-args ...")
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> RunCommand:
    return RunCommand(arguments.node, tuple(arguments.rest), arguments.json)
