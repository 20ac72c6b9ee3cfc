"""A benchmark's result on disk: JSON with everything, Markdown for a reader, pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from octn_ros.evaluation.benchmark import BenchmarkResult, Column, Row, filled_columns


def result_to_plain(result: BenchmarkResult, environment: dict[str, Any]) -> dict[str, Any]:
    """Return a result and where it was measured as JSON can hold them; NaN and infinity become None."""
    plain = _plain(
        {
            "benchmark": result.name,
            "title": result.title,
            "rows": [dict(row) for row in result.rows],
            "paper": [dict(row) for row in result.paper],
            "deviations": list(result.deviations),
            "notes": list(result.notes),
            "configuration": dict(result.configuration),
            "seeds": dict(result.seeds),
            "seconds": result.seconds,
            "pictures": sorted(result.pictures),
            "figures": dict(result.figures),
            **result.figures,
            **environment,
        }
    )
    assert isinstance(plain, dict)
    return plain


def markdown(result: BenchmarkResult, environment: dict[str, Any]) -> str:
    """Return the report for a reader: table, the paper's rows, deviations, how it was run."""
    hardware, versions = environment["hardware"], environment["versions"]
    lines = [
        f"# octn bench {result.name}: {result.title}",
        "",
        f"{environment['date']}, commit {environment['commit'] or 'unknown'}, octn_ros {versions['octn_ros']}, "
        f"torch {versions['torch']}, Python {versions['python']}; {hardware['cpu']}, {hardware['cores']} cores"
        + (f", {hardware['gpu']}" if hardware["gpu"] else "")
        + f"; {result.seconds:.0f} s.",
        "",
        *_figures(result.figures),
        *_table(result.rows, result.columns),
        "",
        *_paper(result),
        *_list("What the figures mean", result.notes),
        *_list("Where the protocol differs from the paper's", result.deviations),
        *[f"![{name}]({name})\n" for name in sorted(result.pictures)],
        "## Configuration",
        "",
        "```json",
        json.dumps(_plain({"seeds": dict(result.seeds), **result.configuration}), indent=1),
        "```",
        "",
    ]
    return "\n".join(lines)


def write_report(folder: Path, result: BenchmarkResult, environment: dict[str, Any]) -> list[Path]:
    """Write `NAME.json`, `NAME.md` and the pictures into an existing folder; return the paths.

    Raises:
        OSError: one of them cannot be written.
    """
    content = json.dumps(result_to_plain(result, environment), indent=1, allow_nan=False)
    written = []
    for name, data in (
        (f"{result.name}.json", f"{content}\n".encode()),
        (f"{result.name}.md", markdown(result, environment).encode()),
        *result.pictures.items(),
    ):
        path = folder / name
        path.write_bytes(data)
        written.append(path)
    return written


def combined_report(
    folder: Path,
    rows: Sequence[Row],
    columns: Sequence[Column],
    environment: dict[str, Any],
    notes: Sequence[str],
) -> str:
    """Return one report of many that lie in a folder as NAME.md: a list of them with links, then each, a level lower.

    Args:
        folder: where they lie.
        rows: one for each, with its name as "benchmark".
        columns: of the list.
        environment: where and with what the list was made.
        notes: what is to be said of them all.
    """
    versions, hardware = environment["versions"], environment["hardware"]
    lines = [
        "# octn bench: the paper's tables and figures",
        "",
        f"{environment['date']}, commit {environment['commit'] or 'unknown'}, octn_ros {versions['octn_ros']}; "
        f"{hardware['cpu']}, {hardware['cores']} cores" + (f", {hardware['gpu']}" if hardware["gpu"] else "") + ".",
        "",
        *_table([{**row, "benchmark": f"[{row['benchmark']}](#{row['benchmark']})"} for row in rows], columns),
        "",
        *(f"- {note}" for note in notes),
        "",
    ]
    for row in rows:
        name = row["benchmark"]
        lines += [f'<a id="{name}"></a>', ""]
        part = folder / f"{name}.md"
        if row["state"] == "failed" or not part.is_file():
            lines += [f"## octn bench {name}", "", "It failed; see above.", ""]
        else:
            lines += [f"#{line}" if line.startswith("#") else line for line in part.read_text("utf-8").splitlines()]
    return "\n".join(lines)


def _paper(result: BenchmarkResult) -> list[str]:
    if not result.paper:
        return []
    columns = [*filled_columns(result.paper, result.columns), Column("source", "where")]
    return ["## The paper's figures", "", *_table(result.paper, columns), ""]


def _table(rows: Sequence[Row], columns: Sequence[Column]) -> list[str]:
    head = "| " + " | ".join(column.title for column in columns) + " |"
    rule = "|" + " --- |" * len(columns)
    return [head, rule, *("| " + " | ".join(column.text(row) for column in columns) + " |" for row in rows)]


def _figures(figures: Mapping[str, float | bool]) -> list[str]:
    if not figures:
        return []
    lines = [f"| {key} | {value if isinstance(value, bool) else f'{value:.4g}'} |" for key, value in figures.items()]
    return ["| figure | |", "| --- | --- |", *lines, ""]


def _list(title: str, sentences: Sequence[str]) -> list[str]:
    return [f"## {title}", "", *(f"- {sentence}" for sentence in sentences), ""] if sentences else []


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
