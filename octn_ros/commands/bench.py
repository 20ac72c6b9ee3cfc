"""`octn bench`: a table of the paper, measured with this package."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal

if TYPE_CHECKING:
    from rich.table import Table

    from octn_ros.evaluation.benchmark import BenchmarkResult, Column

# Named here too, so that the help needs no torch; a test holds them against octn_ros.evaluation.registry.MODULES.
BENCHMARK_NAMES = ("all", "alpha", "band", "bscan", "compare", "curve", "raster", "slices", "sparse", "speed")
_REGION_BENCHMARKS = ("bscan",)
_TABLE_WIDTH = 2000  # more than any table needs
_LABELS = 2  # columns that say what a row is about, the scan and how much of it is used
_PADDING = 3  # letters between two columns


@dataclass(frozen=True)
class BenchCommand:
    """Run one benchmark.

    Attributes:
        name: which.
        data: folder of C-scans, None for phantoms.
        spacing_um: of C-scans that state none, (bscan, axial, lateral).
        device: auto, cpu, cuda, ...
        quick: a reduced run of less than a minute.
        json: print JSON instead of a table.
        output: folder for JSON, Markdown and pictures, None to write nothing, or for all octn-bench or octn-bench-quick
            here.
        regions: YAML or JSON file of regions of interest in the middle B-scan; found automatically if None.
        workers: processes that measure the scans of a folder side by side, 0 for as many as the machine bears.
        scheduler: address of a Dask scheduler whose workers do so instead.
    """

    name: str
    data: Path | None = None
    spacing_um: tuple[float, float, float] | None = None
    device: str = "auto"
    quick: bool = False
    json: bool = False
    output: Path | None = None
    regions: Path | None = None
    workers: int = 0
    scheduler: str | None = None

    def run(self) -> int:
        """Measure, write the report, print the table; return 0.

        Raises:
            OctnError: an argument or the data cannot be used, or nothing at all could be measured.
        """
        if self.data is not None and not self.data.is_dir():
            raise terminal.CommandError(f"{self.data}: expected a folder of C-scans for --data")
        if self.regions is not None and self.name not in _REGION_BENCHMARKS:
            raise terminal.CommandError(f"--rois: expected {', '.join(_REGION_BENCHMARKS)}, {self.name} has no regions")
        if self.workers < 0:
            raise terminal.CommandError(f"--workers: expected a number of processes, got {self.workers}")
        output = self.output
        if output is None and self.name == "all":
            output = Path("octn-bench-quick" if self.quick else "octn-bench")
        if output is not None:
            terminal.make_output_directory(output)
        from octn_ros.evaluation.benchmark import BenchmarkRequest
        from octn_ros.evaluation.environment import environment
        from octn_ros.evaluation.registry import benchmark
        from octn_ros.evaluation.report import result_to_plain, write_report
        from octn_ros.field.device import torch_device

        measure, device = benchmark(self.name), str(torch_device(self.device))
        with terminal.ProgressBar() as bar:
            result = measure(
                BenchmarkRequest(
                    data=self.data,
                    spacing_um=self.spacing_um,
                    device=device,
                    quick=self.quick,
                    progress=bar.show,
                    regions=self.regions,
                    output=output,
                    workers=self.workers,
                    scheduler=self.scheduler,
                )
            )
        surroundings = environment(device)
        values = result_to_plain(result, surroundings) | {"quick": self.quick}
        if output is not None:
            with terminal.writing(output):
                written = write_report(output, result, surroundings)
            values["written"] = [str(path) for path in written]
        if self.json:
            terminal.print_json(values)
        else:
            _print_result(result)
            if output is not None:
                terminal.say(f"report: {output / ('report' if self.name == 'all' else self.name)}.md")
        if not result.rows:
            raise terminal.CommandError("nothing could be measured; the notes of the result say why")
        return 0


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("bench", help="measure a table of the paper", description=__doc__)
    parser.add_argument("name", choices=BENCHMARK_NAMES, metavar="NAME", help=f"one of {', '.join(BENCHMARK_NAMES)}")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of C-scans to measure on")
    common.add_spacing(parser)
    common.add_device(parser)
    parser.add_argument("--quick", action="store_true", help="a reduced run that ends within a minute on two cores")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="write NAME.json, NAME.md and pictures there; a run that was broken off goes on from what it holds",
    )
    parser.add_argument(
        "--rois",
        type=Path,
        metavar="FILE",
        help="for bscan: YAML or JSON list of regions of interest in the middle B-scan, as octn eval takes it",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=0,
        metavar="N",
        help="processes that measure the scans of a folder side by side; as many as the machine bears, 1 without Dask",
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers measure the scans instead")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> BenchCommand:
    return BenchCommand(
        name=arguments.name,
        data=arguments.data,
        spacing_um=common.spacing(arguments),
        device=arguments.device,
        quick=arguments.quick,
        json=arguments.json,
        output=arguments.output,
        regions=arguments.rois,
        workers=arguments.workers,
        scheduler=arguments.scheduler,
    )


def _print_result(result: BenchmarkResult) -> None:
    """Print the table, the paper's rows below it, and what differs from the paper's protocol."""
    from rich.console import Console

    console = Console(highlight=False)
    for key, value in result.figures.items():
        console.print(f"{key}: {value if isinstance(value, bool) else f'{value:.4g}'}", markup=False)
    # What is no terminal gets all columns beside each other, in full, however many they are.
    wide = Console(highlight=False, width=_TABLE_WIDTH)
    title = f"{result.name}: {result.title}"
    for columns in _side_by_side(result, console.width if console.is_terminal else _TABLE_WIDTH):
        wide.print(_table(title, result, columns))
        title = ""
    for sentence in (*result.notes, *result.deviations):
        console.print(f"- {sentence}", markup=False)


def _side_by_side(result: BenchmarkResult, width: int) -> list[list[Column]]:
    """Return the columns that one row holds, in tables below each other where they are wider than a terminal.

    Each table begins with the columns that say what a row is about. Columns without any value are left out.
    """
    from octn_ros.evaluation.benchmark import filled_columns

    rows = [*result.rows, *result.paper]
    columns = filled_columns(rows, result.columns)
    labels, others = columns[:_LABELS], columns[_LABELS:]
    sizes = {
        column.key: _PADDING + max(len(column.title), *(len(column.text(row)) for row in rows)) for column in columns
    }
    first = sum(sizes[column.key] for column in labels)
    tables, used = [list(labels)], first
    for column in others:
        if used + sizes[column.key] > width and len(tables[-1]) > len(labels):
            tables.append(list(labels))
            used = first
        tables[-1].append(column)
        used += sizes[column.key]
    return tables


def _table(title: str, result: BenchmarkResult, columns: list[Column]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(title=title or None, title_justify="left", box=box.SIMPLE_HEAD)
    for column in columns:
        words = any(isinstance(row.get(column.key), str) for row in result.rows)
        table.add_column(column.title, justify="left" if words else "right", no_wrap=True)
    for row in result.rows:
        table.add_row(*(column.text(row) for column in columns))
    table.add_section()
    for row in result.paper:
        table.add_row(*(column.text(row) for column in columns), style="dim")
    return table
