"""The process in which oct-converter reads a vendor's file: `python -m octn_ros.volume.vendor_process`.

It writes the voxels [bscan, axial, lateral] to a .npy file and prints one JSON object about them. What goes wrong is
one line on stderr and exit code 1.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import re
import resource
import struct
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ZEISS_AXES = re.compile(r"(\d{2,4})x(\d{2,4})")
_READ_ERROR = "Stopping load"  # what the Bioptigen reader prints before it returns memory that was never filled


def main() -> int:
    """Read one file as the arguments say; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path, help="the vendor's file")
    parser.add_argument("output", type=Path, help="the .npy file to write")
    parser.add_argument("cpu_s", type=int, help="processor time after which the system ends the process")
    parser.add_argument("memory_bytes", type=int, help="address space beyond which it gets no more memory")
    parser.add_argument("--variable", help="which volume, if the file holds several")
    arguments = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_CPU, (arguments.cpu_s, arguments.cpu_s))
    resource.setrlimit(resource.RLIMIT_AS, (arguments.memory_bytes, arguments.memory_bytes))
    said = io.StringIO()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(said):  # the library prints remarks
            warnings.simplefilter("ignore")
            voxels, spacing_m = _read(arguments.path, arguments.variable)
        if _READ_ERROR in said.getvalue():
            raise ValueError("the file ends before its voxels do")
        if voxels.ndim != 3 or voxels.dtype.kind not in "uif":
            raise ValueError(f"expected a volume of numbers, got {voxels.shape} of {voxels.dtype}")
        np.save(arguments.output, voxels, allow_pickle=False)
    except Exception as error:  # the library raises anything at all when a file is damaged
        print(" ".join(f"{type(error).__name__}: {error}".split())[:300], file=sys.stderr)
        return 1
    print(json.dumps({"shape": voxels.shape, "dtype": voxels.dtype.str, "spacing_m": spacing_m}))
    return 0


def _read(path: Path, variable: str | None) -> tuple[NDArray[Any], tuple[float, float, float] | None]:
    # oct-converter 0.7 calls the binary mode of fromstring, which NumPy 2.3 has removed; in this process only.
    np.fromstring = np.frombuffer  # type: ignore[assignment]
    from oct_converter import readers

    kinds: dict[str, Callable[[Any, Path, str | None], tuple[NDArray[Any], tuple[float, float, float] | None]]] = {
        ".fds": lambda library, file, _: _topcon(library.FDS(file).read_oct_volume()),
        ".fda": lambda library, file, _: _topcon(library.FDA(file).read_oct_volume()),
        ".e2e": _heidelberg,
        ".oct": _bioptigen_or_optovue,
        ".img": _zeiss,
    }
    return kinds[path.suffix.lower()](readers, path, variable)


def _topcon(scan: Any) -> tuple[NDArray[Any], tuple[float, float, float] | None]:
    spacing_m = None
    if scan.pixel_spacing is not None:
        lateral, bscan, axial = (float(s) * 1e-3 for s in scan.pixel_spacing)
        spacing_m = (bscan, axial, lateral)
    return np.stack(scan.volume), spacing_m


def _heidelberg(library: Any, path: Path, variable: str | None) -> tuple[NDArray[Any], None]:
    _check_directories(path)
    scans = library.E2E(path).read_oct_volume()
    # The library's lateral and B-scan spacings are defaults of its own: never taken.
    return _chosen({str(scan.volume_id): np.stack(scan.volume) for scan in scans}, variable), None


def _check_directories(path: Path) -> None:
    """Refuse a file whose directories run in a circle, in which the library would follow them for ever."""
    with path.open("rb") as file:
        start = 64 if file.read(21) == b"E2EMultipleVolumeFile" else 0
        file.seek(start + 36)  # behind the header; every directory ends with its place, the one before it and a number
        place = struct.unpack("<I", file.read(52)[40:44])[0]
        seen: set[int] = set()
        while place:
            if place in seen:
                raise ValueError("its directories run in a circle")
            seen.add(place)
            file.seek(start + place)
            place = struct.unpack("<I", file.read(52)[44:48])[0]


def _bioptigen_or_optovue(library: Any, path: Path, variable: str | None) -> tuple[NDArray[Any], None]:
    if path.with_suffix(".txt").exists():  # Optovue keeps the shape beside its file, [bscan, axial, lateral]
        scans = library.POCT(path).read_oct_volume()
        return _chosen({str(index): np.stack(scan.volume) for index, scan in enumerate(scans)}, variable), None
    scans = library.BOCT(path).read_oct_volume()
    named = {str(index): np.swapaxes(scan.volume, 1, 2) for index, scan in enumerate(scans)}  # A-scans last
    return _chosen(named, variable), None


def _zeiss(library: Any, path: Path, _: str | None) -> tuple[NDArray[Any], None]:
    axes = _ZEISS_AXES.search(path.name)
    if axes is None:
        raise ValueError(
            "an .img file has no header; expected its size in its name, as Zeiss has it: lateral x bscan, e.g. 512x128"
        )
    laterals, bscans = int(axes[1]), int(axes[2])
    axials, rest = divmod(path.stat().st_size, laterals * bscans)
    if rest or axials < 2:
        raise ValueError(f"the file's {path.stat().st_size:,} bytes are no multiple of {laterals} x {bscans} A-scans")
    return np.stack(library.IMG(path).read_oct_volume(rows=axials, cols=laterals).volume), None


def _chosen(volumes: dict[str, NDArray[Any]], variable: str | None) -> NDArray[Any]:
    listed = ", ".join(f"{name} {array.shape}" for name, array in volumes.items()) or "none"
    if variable is None and len(volumes) == 1:
        return next(iter(volumes.values()))
    if variable is None or variable not in volumes:
        raise ValueError(f"name one volume with --variable (in Python variable), the file holds {listed}")
    return volumes[variable]


if __name__ == "__main__":
    sys.exit(main())
