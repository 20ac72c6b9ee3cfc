"""The command line `octn`: reads the arguments, runs one command, turns errors into one line and an exit code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from octn_ros import __version__
from octn_ros.commands import band, bench, calibrate, convert, demo, eval, fit, info, plan, run, slice, surface
from octn_ros.errors import OctnError
from octn_ros.openmp import wait_passively

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells have it


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 2 for a bad argument or file, 130 after an interrupt.

    Args:
        argv: the arguments without the program's name; those of the process if None.
    """
    wait_passively()
    try:
        arguments = _parser().parse_args(argv)
    except SystemExit as stop:  # --help, --version or a bad argument; argparse has said what there is to say
        return int(stop.code or 0)
    name = f"octn {arguments.command}"
    try:
        code = arguments.read(arguments).run()
    except OctnError as error:
        print(f"{name}: error: {_one_line(error)}", file=sys.stderr)
        code = EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        code = EXIT_INTERRUPTED
    if argv is None and "octn_ros.nodes" in sys.modules:  # a command that ran nodes, in a process that ends with it
        from octn_ros.nodes.process import leave_workers_behind

        leave_workers_behind(code)
    return code


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="octn",
        description="Fit a neural field to an OCT C-scan and plan a laser path over its surface.",
        epilog="Research software, no medical device.",
    )
    parser.add_argument("--version", action="version", version=f"octn {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for command in (demo, fit, eval, slice, surface, band, plan, calibrate, run, info, convert, bench):
        command.add_parser(commands)
    return parser


def _one_line(error: OctnError) -> str:
    return " ".join(str(error).split())


if __name__ == "__main__":
    sys.exit(main())
