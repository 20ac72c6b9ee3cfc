"""`octn demo`: simulated scanner, trainer, planner and arm in one process, from a C-scan to an executed laser path."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal

if TYPE_CHECKING:
    from octn_ros.demo.closed_loop_result import ClosedLoopResult
    from octn_ros.demo.result import DemoResult
    from octn_ros.demo.session import Show
    from octn_ros.demo.source import ScanSource

# The quick fit ends by its steps on any machine.
FIT: dict[str, Any] = {"fit.time_budget_s": 10.0}
QUICK_FIT: dict[str, Any] = {"fit.time_budget_s": 90.0, "fit.steps": 80}
QUICK_SHAPE = (40, 80, 80)
# The closed loop fits once for each pass, from the last field on.
CLOSED_LOOP_FIT: dict[str, Any] = {"fit.time_budget_s": 6.0}
CLOSED_LOOP_DEPTH_UM = 300.0
QUICK_CLOSED_LOOP: dict[str, Any] = {"shape": (40, 96, 80), "wave_amplitude_m": 40e-6}
QUICK_CLOSED_LOOP_SIDE_M = 0.6e-3


@dataclass(frozen=True)
class DemoCommand:
    """Run the whole chain once.

    Attributes:
        volume: a recorded C-scan to play instead of the phantom.
        spacing_um: its spacing along (bscan, axial, lateral), overrides the file's.
        output: directory for the report.
        quick: a small phantom and a short fit.
        json: print JSON instead of a table.
        closed_loop: ablate the phantom to a depth, pass by pass, instead of executing one plan.
        depth_um: that depth, None for 300 um.
        record: a file for a recording of the graph (MCAP), None for none.
    """

    volume: Path | None = None
    spacing_um: tuple[float, float, float] | None = None
    output: Path = Path("demo_output")
    quick: bool = False
    json: bool = False
    closed_loop: bool = False
    depth_um: float | None = None
    record: Path | None = None

    def run(self) -> int:
        """Run the chain, write the report, print the figures; return 0.

        Raises:
            OctnError: an argument or a file cannot be used, or a node refused or failed.
        """
        if self.spacing_um is not None and self.volume is None:
            raise terminal.CommandError("--spacing-um describes a recorded C-scan: expected --volume FILE beside it")
        if self.depth_um is not None and not self.closed_loop:
            raise terminal.CommandError("--depth-um is how deep to ablate: expected --closed-loop beside it")
        if self.closed_loop and self.volume is not None:
            raise terminal.CommandError("--closed-loop needs tissue that can be cut: expected no --volume beside it")
        terminal.make_output_directory(self.output)
        with self._recording_told(), terminal.ProgressBar() as bar:
            bar.show("loading", 0.0)
            result = self._ablate(bar.show) if self.closed_loop else self._execute_plan(bar.show)
        if self.json:
            terminal.print_json(result.to_plain())
        else:
            terminal.print_table("octn demo --closed-loop" if self.closed_loop else "octn demo", result.rows())
            terminal.say(f"Report: {result.report}")
            if self.record is not None:
                terminal.say(f"Recording: {self.record}")
        return 0

    @contextmanager
    def _recording_told(self) -> Iterator[None]:
        """Of a demo that fails or is interrupted, say where the recording lies that shows why."""
        before = _written_ns(self.record)
        try:
            yield
        except BaseException:
            if _written_ns(self.record) != before:
                terminal.say(f"Recording up to then: {self.record}")
            raise

    def _execute_plan(self, show: Show) -> DemoResult:
        start = time.perf_counter()
        source = self._source()  # first: a file that cannot be used is told of before all else is imported
        from octn_ros.demo.run import run_demo

        seconds = {"load": time.perf_counter() - start}
        return run_demo(source, QUICK_FIT if self.quick else FIT, self.output, show, seconds, self.record)

    def _ablate(self, show: Show) -> ClosedLoopResult:
        from octn_ros.demo.ablation_request import AblationRequest
        from octn_ros.demo.closed_loop_report import closed_loop_demo
        from octn_ros.demo.rectangle import LARGEST_SIDE_M, centred_rectangle
        from octn_ros.simulation import PhantomConfig

        config = PhantomConfig(**QUICK_CLOSED_LOOP) if self.quick else PhantomConfig()
        largest = QUICK_CLOSED_LOOP_SIDE_M if self.quick else LARGEST_SIDE_M
        depth_um = CLOSED_LOOP_DEPTH_UM if self.depth_um is None else self.depth_um
        request = AblationRequest(depth_um * 1e-6, centred_rectangle(config.geometry, largest_m=largest))
        fit = QUICK_FIT if self.quick else CLOSED_LOOP_FIT
        return closed_loop_demo(config, request, fit, self.output, show, self.record)

    def _source(self) -> ScanSource:
        from octn_ros.demo.source import phantom_source, recorded_source
        from octn_ros.simulation import PhantomConfig

        if self.volume is not None:
            return recorded_source(self.volume, self.spacing_um)
        return phantom_source(PhantomConfig(shape=QUICK_SHAPE) if self.quick else PhantomConfig())


def _written_ns(path: Path | None) -> int:
    """When a file was last written, 0 for none."""
    return path.stat().st_mtime_ns if path is not None and path.is_file() else 0


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("demo", help="run the whole chain on a phantom or a recording", description=__doc__)
    parser.add_argument("--volume", type=Path, metavar="FILE", help="a recorded C-scan to play instead of the phantom")
    common.add_spacing(parser)
    parser.add_argument(
        "--output", type=Path, default=Path("demo_output"), metavar="DIR", help="for the report; default demo_output"
    )
    parser.add_argument(
        "--closed-loop", action="store_true", help="ablate the phantom to a depth: scan, fit, plan, fire, scan again"
    )
    parser.add_argument("--depth-um", type=float, metavar="UM", help="that depth; default 300")
    parser.add_argument(
        "--record", type=Path, metavar="FILE", help="record all topics into one MCAP file, which Foxglove opens"
    )
    parser.add_argument("--quick", action="store_true", help="a small phantom and a short fit")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> DemoCommand:
    return DemoCommand(
        arguments.volume,
        common.spacing(arguments),
        arguments.output,
        arguments.quick,
        arguments.json,
        arguments.closed_loop,
        arguments.depth_um,
        arguments.record,
    )
