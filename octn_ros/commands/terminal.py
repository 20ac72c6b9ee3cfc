"""What people and machines see: tables and progress bars on the terminal, one JSON object on stdout."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from octn_ros.errors import OctnError


class CommandError(OctnError):
    """An argument or an output file of a command cannot be used."""


class ProgressBar:
    """One bar on stderr for each thing that is going on, one after the other; use it as a context manager."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, Task, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.table import Column
        from rich.text import Text

        class Remark(TextColumn):
            """Alone gives way on a narrow terminal: cut at the end, and the other columns stay whole."""

            def render(self, task: Task) -> Text:
                text = super().render(task)
                text.no_wrap, text.overflow = True, "ellipsis"
                return text

        whole = Column(no_wrap=True)
        self._progress = Progress(
            TextColumn("{task.description:<18}"),
            BarColumn(bar_width=20, table_column=whole),
            TaskProgressColumn(),
            TimeElapsedColumn(table_column=whole),
            Remark("{task.fields[remark]}", style="dim", table_column=Column(no_wrap=False)),
            console=Console(stderr=True),
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self._complete()
        if self._tasks:  # without a bar, its end would be an empty line
            self._progress.stop()

    def show(self, title: str, fraction: float, remark: str = "") -> None:
        """Move the bar of that title to `fraction` of 1; a new title completes the bars before it. Thread-safe."""
        if title not in self._tasks:
            self._progress.start()
            self._complete()
            self._tasks[title] = self._progress.add_task(title, total=1.0, remark=remark)
        self._progress.update(self._tasks[title], completed=min(max(fraction, 0.0), 1.0), remark=remark)

    def _complete(self) -> None:
        for task in self._tasks.values():
            self._progress.update(task, completed=1.0)


def print_json(values: dict[str, Any]) -> None:
    """Print one JSON object on stdout; numbers that JSON cannot hold (NaN, infinity) become null."""
    print(json.dumps(_plain(values), allow_nan=False), flush=True)


def print_table(title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print named values on stdout as a table."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, show_header=False)
    table.add_column(style="dim")
    table.add_column()
    for name, value in rows:
        table.add_row(name, value)
    Console(highlight=False).print(table)


def say(text: str) -> None:
    """Print a line for people on stderr, where it disturbs no machine."""
    from rich.console import Console

    Console(stderr=True, highlight=False).print(text, markup=False)


def check_output_file(path: Path) -> None:
    """Find out before the work whether a file can be written.

    Raises:
        CommandError: its folder is missing or cannot be written to, or a folder of that name is in the way.
    """
    if path.is_dir():
        raise CommandError(f"{path}: expected a file to write, got a directory")
    with writing(path):
        # Permissions alone do not tell (root, read-only mounts); a file that can be made does.
        tempfile.TemporaryFile(dir=path.parent).close()


def make_output_directory(path: Path) -> None:
    """Make a directory, with its parents, and find out whether it can be written to.

    Raises:
        CommandError: it cannot.
    """
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8.

    Raises:
        CommandError: it cannot be written.
    """
    with writing(path):
        path.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a binary file, a picture for instance.

    Raises:
        CommandError: it cannot be written.
    """
    with writing(path):
        path.write_bytes(content)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Write `path` inside, by whatever means.

    Raises:
        CommandError: it cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise CommandError(f"{path}: cannot write here: {error.strerror or error}") from error


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
