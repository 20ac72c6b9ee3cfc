"""`octn bench all`: every benchmark, one after the other, and one report of them."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octn_ros.errors import OctnError
from octn_ros.evaluation import registry
from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column, Progress
from octn_ros.evaluation.environment import code_hash, environment
from octn_ros.evaluation.report import combined_report, write_report
from octn_ros.evaluation.scans import scan_sources
from octn_ros.settings import as_plain, check_settings, setting

COLUMNS = (
    Column("benchmark", "benchmark"),
    Column("state", "state"),
    Column("seconds", "s", "{:.0f}"),
    Column("rows", "rows"),
    Column("title", "what"),
)
REPORT = "report.md"


@dataclass(frozen=True)
class AllBenchConfig:
    """Which benchmarks are run."""

    names: tuple[str, ...] = setting(
        tuple(sorted(set(registry.MODULES) - {"all"})), "benchmarks by name, in the order of the report"
    )

    def __post_init__(self) -> None:
        check_settings(self)


def run(request: BenchmarkRequest, config: AllBenchConfig | None = None) -> BenchmarkResult:
    """Run every benchmark and write its report, and one of all, into `request.output`.

    One that fails is named and stops nothing. What an earlier run of the same code, data, device and size has finished
    is taken from there: NAME.json, NAME.md and its pictures. Those that measure on phantoms alone do so even where a
    folder is given. Without `request.output` nothing but the list is left.

    Raises:
        OctnError: the folder holds no scan.
        OSError: a report cannot be written.
    """
    config = config or AllBenchConfig()
    began = time.perf_counter()
    # A folder without scans is an error of the call, not of every benchmark.
    sources = [] if request.data is None else scan_sources(request, (), (8, 8, 8), 0)
    data = [(source.name, source.fingerprint) for source in sources]
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for number, name in enumerate(config.names):
        on_data = name not in registry.PHANTOMS_ALONE
        key = _key(name, request, data if on_data else [])
        title = f"{number + 1}/{len(config.names)} {name}"
        request.progress(title, 0.0, "")
        row = _finished(request.output, name, key)
        if row is None:
            part = dataclasses.replace(request, progress=_titled(request.progress, title))
            if not on_data:
                part = dataclasses.replace(part, data=None, spacing_um=None)
            row, failure = _measured(name, part, key)
            notes += failure
        rows.append(row)
        if request.output is not None:
            text = combined_report(request.output, rows, COLUMNS, environment(request.device), notes)
            (request.output / REPORT).write_text(text, encoding="utf-8")
    if request.data is not None:
        alone = [name for name in config.names if name in registry.PHANTOMS_ALONE]
        notes.append(f"Measured on phantoms, whatever folder is given: {', '.join(alone)}.")
    return BenchmarkResult(
        name="all",
        title="every benchmark",
        rows=rows,
        columns=COLUMNS,
        paper=(),
        deviations=(),
        notes=notes,
        configuration={"bench": as_plain(config)},
        seeds={},
        seconds=time.perf_counter() - began,
    )


def _measured(name: str, request: BenchmarkRequest, key: str) -> tuple[dict[str, Any], list[str]]:
    """Run one benchmark and write its report; return its row, and what went wrong, if something did."""
    began = time.perf_counter()
    try:
        result = registry.benchmark(name)(request)
    except Exception as error:  # whatever it is, it must not end the others' work
        where = "" if isinstance(error, OctnError) else f" ({traceback.extract_tb(error.__traceback__)[-1]})"
        failure = f"{name} failed: {type(error).__name__}: {error}{where}"
        return {"benchmark": name, "state": "failed", "seconds": time.perf_counter() - began}, [failure]
    if request.output is not None:
        write_report(request.output, result, {**environment(request.device), "key": key})
    return _row(name, "measured", result.seconds, result.rows, result.title), []


def _finished(output: Path | None, name: str, key: str) -> dict[str, Any] | None:
    """Return the row of a benchmark that an earlier run has finished; None if it has not, or not by this key."""
    if output is None:
        return None
    try:
        content = json.loads((output / f"{name}.json").read_text(encoding="utf-8"))
        files = [f"{name}.md", *content["pictures"]]
        if content["key"] == key and all((output / file).is_file() for file in files):
            return _row(name, f"measured {content['date']}", content["seconds"], content["rows"], content["title"])
    except (OSError, ValueError, KeyError, TypeError):  # it is then measured again
        pass
    return None


def _row(name: str, state: str, seconds: float, rows: Sequence[Mapping[str, Any]], title: str) -> dict[str, Any]:
    return {"benchmark": name, "state": state, "seconds": seconds, "rows": len(rows), "title": title}


def _key(name: str, request: BenchmarkRequest, data: Sequence[tuple[str, str]]) -> str:
    """Return a hash of all that decides a benchmark's figures, but for the machine."""
    deciding = [code_hash(), name, data, request.spacing_um, request.device, request.quick]
    return hashlib.sha256(json.dumps(deciding).encode()).hexdigest()


def _titled(progress: Progress, title: str) -> Progress:
    """Tell the progress of one benchmark under its number and name."""

    def tell(what: str, share: float, remark: str = "") -> None:
        progress(f"{title}: {what}", share, remark)

    return tell
