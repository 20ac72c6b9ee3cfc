"""A benchmark's work on many scans: one after the other or side by side, failures told, nothing measured twice."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from importlib.util import find_spec
from typing import Any

from octn_ros.errors import ConfigurationError, in_words
from octn_ros.evaluation.benchmark import BenchmarkRequest, Row
from octn_ros.evaluation.kept_rows import KeptRows, ScanResult
from octn_ros.evaluation.scans import BenchScan, ScanSource

# What is done with one scan. It goes to other processes, so it is a module's function, or a partial of one.
Work = Callable[[BenchScan], ScanResult]
# A scan of the paper's size, as voxels, as float32, and in what is made of it.
_GIGABYTES_PER_SCAN = 6.0


@dataclass(frozen=True)
class ScansResult:
    """What became of all scans, in the order of their sources.

    Attributes:
        rows: of all of them.
        pictures: PNG content by file name.
        notes: what was said of single scans, which failed, and how they were measured, one sentence each.
    """

    rows: Sequence[Row]
    pictures: Mapping[str, bytes] = dataclass_field(default_factory=dict)
    notes: Sequence[str] = ()


def run_volumes(
    sources: Sequence[ScanSource],
    work: Work,
    request: BenchmarkRequest,
    *,
    name: str,
    configuration: Mapping[str, Any],
    timed: bool = False,
) -> ScansResult:
    """Do a benchmark's work on every scan.

    A scan that cannot be loaded or measured is named in the notes and stops nothing. With `request.output`, what was
    made of a scan is kept there as soon as it is done; the same code with the same settings and the same file then
    takes it from there. The scans of a folder are measured side by side by processes of this machine where Dask
    (`pip install octn_ros[bench]`) and more than one core are there, or by those of `request.scheduler`; the figures
    are the same either way, up to the rounding of sums that threads share.

    Args:
        sources: the scans.
        work: what is done with each, a function that can be pickled and depends on nothing but the scan.
        request: where to keep what is done, how many side by side, or on which cluster; told of progress.
        name: of the benchmark.
        configuration: every setting that decides the figures, as JSON can hold it.
        timed: whether seconds are what is measured; scans then never share this machine.

    Raises:
        ConfigurationError: a cluster is asked for and Dask is missing, or it does not answer, or runs other code.
    """
    kept = KeptRows(request.output, name, configuration, request.device)
    results: dict[int, ScanResult] = {}
    failed: dict[int, str] = {}
    for number, source in enumerate(sources):
        if (before := kept.read(source)) is not None:
            results[number] = before
    notes = []
    if results:
        notes.append(
            f"{len(results)} of {len(sources)} scans were measured by an earlier run of the same code and settings "
            f"({request.output}), and not again."
        )
    left = [number for number in range(len(sources)) if number not in results]
    processes = 1 if timed and request.scheduler is None else process_count(len(left), request)
    todo = [sources[number] for number in left]
    if request.scheduler is not None or processes > 1:
        from octn_ros.evaluation.side_by_side import measure_side_by_side

        outcomes = measure_side_by_side(todo, work, processes, request.scheduler)
        notes.append(
            f"Scans were measured side by side by the workers of {request.scheduler}: times are theirs."
            if request.scheduler
            else f"Scans were measured by {processes} processes side by side: times are of a machine that they shared."
        )
    else:
        outcomes = _one_by_one(todo, work, request, name)
    for done, (place, outcome) in enumerate(outcomes):
        source = todo[place]
        request.progress(f"{name} scans", (done + 1) / len(todo), source.name)
        if isinstance(outcome, ScanResult):
            results[left[place]] = outcome
            kept.write(source, outcome)
        else:
            failed[left[place]] = f"{source.name} is left out: {in_words(outcome)}."
    rows: list[Row] = []
    pictures: dict[str, bytes] = {}
    for number in range(len(sources)):
        if number in results:
            rows += results[number].rows
            notes += results[number].notes
            pictures |= results[number].pictures
        else:
            notes.append(failed[number])
    return ScansResult(rows, pictures, notes)


def process_count(scans: int, request: BenchmarkRequest) -> int:
    """Return how many processes of this machine take part: as asked; else 1, or for a folder as many as it bears."""
    if request.workers:
        if request.workers > 1 and not dask_is_there():
            raise ConfigurationError(
                f"workers: expected 1 without Dask, got {request.workers}; pip install 'octn_ros[bench]'"
            )
        return min(request.workers, max(scans, 1))
    if request.data is None or request.device.startswith("cuda") or not dask_is_there():
        return 1
    return max(1, min(scans, cores(), int(_memory_gigabytes() / _GIGABYTES_PER_SCAN)))


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def dask_is_there() -> bool:
    """Return whether Dask's scheduler and workers are installed; loads nothing."""
    return find_spec("distributed") is not None


def _one_by_one(
    sources: Sequence[ScanSource], work: Work, request: BenchmarkRequest, name: str
) -> Iterator[tuple[int, ScanResult | Exception]]:
    for number, source in enumerate(sources):
        request.progress(f"{name} scans", number / len(sources), source.name)
        try:
            yield number, work(source.load())
        except Exception as error:  # whatever it is, it must not end the others' work
            yield number, error


def _memory_gigabytes() -> float:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, OSError, AttributeError):  # not told on this system
        return _GIGABYTES_PER_SCAN
