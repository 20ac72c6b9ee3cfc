"""What a benchmark is given and what it hands back, whatever it measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any, Protocol

# Told as a benchmark goes on: what is being done, the share of it that is done, and a remark.
Progress = Callable[[str, float, str], None]
Row = Mapping[str, Any]


def silent(title: str, share: float, remark: str = "") -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class BenchmarkRequest:
    """What a benchmark shall work on.

    Attributes:
        data: folder of C-scans, None for phantoms alone.
        spacing_um: micrometres along (bscan, axial, lateral), for scans that state none; None to trust theirs.
        device: where fields are fitted and evaluated: auto, cpu, cuda, ...
        quick: a reduced run that ends within a minute on two cores.
        progress: told how far it is.
        regions: file of regions of interest in the middle B-scan, for the benchmark that looks into it; None to have
            them found.
        output: folder of the report, which exists; what is done is kept there, and a run that was broken off goes on
            from it. None to keep nothing.
        workers: processes of this machine that measure scans side by side, 0 for as many as it bears.
        scheduler: address of a Dask scheduler whose workers measure scans instead.
    """

    data: Path | None = None
    spacing_um: tuple[float, float, float] | None = None
    device: str = "auto"
    quick: bool = False
    progress: Progress = silent
    regions: Path | None = None
    output: Path | None = None
    workers: int = 0
    scheduler: str | None = None


@dataclass(frozen=True)
class Column:
    """One column of the Markdown table.

    Attributes:
        key: of the rows.
        title: above the column.
        form: how a number is written, for `str.format`.
        scale: what a number is multiplied by before, 100 for per cent.
    """

    key: str
    title: str
    form: str = "{}"
    scale: float = 1.0

    def text(self, row: Row) -> str:
        """Return the cell of a row; a dash for what is not there."""
        value = row.get(self.key)
        if value is None or value != value:
            return "-"
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return self.form.format(value if self.scale == 1.0 else value * self.scale)
        return str(value)


def filled_columns(rows: Sequence[Row], columns: Sequence[Column]) -> list[Column]:
    """Return the columns for which at least one row has something."""
    return [column for column in columns if any(row.get(column.key) is not None for row in rows)]


@dataclass(frozen=True)
class BenchmarkResult:
    """Everything a reader needs to judge a benchmark, and to run it again.

    Attributes:
        name: of the benchmark, as on the command line.
        title: what it measures, in one line.
        rows: the figures, one dict with plain keys for each line of the table.
        columns: the columns of the table, in order.
        paper: the paper's own figures as rows of the same keys, with "source" saying where they stand.
        deviations: where the protocol differs from the paper's, one sentence each.
        notes: what the figures mean and what was found, one sentence each.
        configuration: every setting that decides the figures, as JSON can hold it.
        seeds: every seed by its name.
        pictures: PNG content by file name.
        seconds: how long it took.
        figures: the few figures that stand for the whole, by plain keys; in the JSON they lie at the top as well.
    """

    name: str
    title: str
    rows: Sequence[Row]
    columns: Sequence[Column]
    paper: Sequence[Row]
    deviations: Sequence[str]
    notes: Sequence[str]
    configuration: Mapping[str, Any]
    seeds: Mapping[str, int]
    seconds: float
    pictures: Mapping[str, bytes] = dataclass_field(default_factory=dict)
    figures: Mapping[str, float | bool] = dataclass_field(default_factory=dict)


class Benchmark(Protocol):
    """One table or figure of the paper; a module of this room offers it as `run`."""

    def __call__(self, request: BenchmarkRequest) -> BenchmarkResult:
        """Measure.

        Raises:
            OctnError: the data cannot be used.
        """
        ...
