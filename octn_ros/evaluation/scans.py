"""What a benchmark is run on: named phantoms with their truth, or every C-scan in a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from octn_ros.errors import VolumeError
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.datasets import DataSet, SetScan, set_scan
from octn_ros.simulation import PhantomConfig, make_phantom, named_phantom
from octn_ros.volume import Volume, scan_files


@dataclass(frozen=True, eq=False)
class BenchScan:
    """A C-scan of a benchmark.

    Attributes:
        name: in the table.
        volume: as measured.
        truth: without noise, None if nobody knows.
        phantom: what it was made from, None for a measured scan.
    """

    name: str
    volume: Volume
    truth: Volume | None = None
    phantom: PhantomConfig | None = None

    @property
    def file_name(self) -> str:
        """The name as a part of file names."""
        return _as_file_name(self.name)


@dataclass(frozen=True)
class ScanSource:
    """A C-scan that is loaded, or made, when its turn comes; immutable.

    Attributes:
        name: in the table.
        load: gives the scan.
        data_set: the published set it belongs to, None for any other.
        fingerprint: tells a file from another that takes its place; empty for a phantom, which its settings tell.
    """

    name: str
    load: Callable[[], BenchScan]
    data_set: DataSet | None = None
    fingerprint: str = ""

    @property
    def file_name(self) -> str:
        """The name as a part of file names."""
        return _as_file_name(self.name)


def scan_sources(
    request: BenchmarkRequest, phantoms: Sequence[str], shape: tuple[int, int, int], seed: int
) -> list[ScanSource]:
    """Return the scans of the request's folder; of the phantoms, if none is given.

    Args:
        request: the folder, and the spacing of files that state none.
        phantoms: names of phantoms.
        shape: of every phantom.
        seed: of their tissue and speckle.

    Raises:
        VolumeError: the folder holds no C-scan.
    """
    if request.data is None:
        return [_phantom(name, shape, seed) for name in phantoms]
    scans = [scan for path in scan_files(request.data) if (scan := set_scan(path, request.data)) is not None]
    if not scans:
        raise VolumeError(f"{request.data}: expected a folder with C-scans in a format of docs/volumes.md, found none")
    return [_file(scan, request.spacing_um) for scan in scans]


def stated_spacings(sources: Sequence[ScanSource], request: BenchmarkRequest) -> Iterator[str]:
    """Say for a result where the spacing of each published set among the scans comes from, a sentence each."""
    for data_set in dict.fromkeys(source.data_set for source in sources):
        if data_set is not None and request.spacing_um is not None:
            yield f"{data_set.name}: the spacing that was given, {request.spacing_um} um (bscan, axial, lateral)."
        elif data_set is not None:
            yield f"{data_set.name}: the spacing is {data_set.spacing}."


def _phantom(name: str, shape: tuple[int, int, int], seed: int) -> ScanSource:
    def load() -> BenchScan:
        phantom = make_phantom(named_phantom(name, seed=seed, tissue_seed=seed, shape=shape))
        return BenchScan(name, phantom.volume, phantom.truth, phantom.config)

    return ScanSource(name, load)


def _file(scan: SetScan, spacing_um: tuple[float, float, float] | None) -> ScanSource:
    fingerprint = f"{spacing_um} {_state(scan.path)}"
    return ScanSource(scan.name, lambda: BenchScan(scan.name, scan.load(spacing_um)), scan.data_set, fingerprint)


def _state(path: Path) -> list[tuple[str, int, int]]:
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    try:
        return [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    except OSError:  # whoever loads it hears what is wrong
        return []


def _as_file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-." else "-" for letter in name)
