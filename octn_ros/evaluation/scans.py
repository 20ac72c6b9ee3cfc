"""What a benchmark is run on: named phantoms with their truth, or every C-scan in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from octn_ros.errors import VolumeError
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import Volume, load_volume, scan_files


@dataclass(frozen=True, eq=False)
class BenchScan:
    """A C-scan of a benchmark.

    Attributes:
        name: in the table.
        volume: as measured.
        truth: without noise, None if nobody knows.
    """

    name: str
    volume: Volume
    truth: Volume | None = None


@dataclass(frozen=True)
class ScanSource:
    """A C-scan that is loaded, or made, when its turn comes; immutable.

    Attributes:
        name: in the table.
        load: gives the scan.
    """

    name: str
    load: Callable[[], BenchScan]


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
    paths = scan_files(request.data)
    if not paths:
        raise VolumeError(f"{request.data}: expected a folder with C-scans in a format of docs/volumes.md, found none")
    return [_file(path, request.data, request.spacing_um) for path in paths]


def _phantom(name: str, shape: tuple[int, int, int], seed: int) -> ScanSource:
    def load() -> BenchScan:
        phantom = make_phantom(named_phantom(name, seed=seed, tissue_seed=seed, shape=shape))
        return BenchScan(name, phantom.volume, phantom.truth)

    return ScanSource(name, load)


def _file(path: Path, folder: Path, spacing_um: tuple[float, float, float] | None) -> ScanSource:
    name = str(path.relative_to(folder))
    return ScanSource(name, lambda: BenchScan(name, load_volume(path, spacing_um)))
