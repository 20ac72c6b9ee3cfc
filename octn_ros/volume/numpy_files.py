"""C-scans in NumPy's files: `.npy`, one array and nothing else, and `.npz`, named arrays. Nothing is ever unpickled."""

from __future__ import annotations

import dataclasses
import math
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.named_arrays import VOLUME_KEY, choose_array
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader
from octn_ros.volume.volume import Volume

_HEADER_KEYS = tuple(field.name for field in dataclasses.fields(ScanHeader))
_MAX_HEADER_VALUE_BYTES = 4096


def read_npy(path: Path, request: ReadRequest) -> RawScan:
    """Read the header of a .npy file; its voxels are mapped into memory, not copied, where their type is kept.

    The file must not be shortened while the volume is in use: the operating system ends a process that reads a
    mapping beyond the end of its file. Replacing the file, as this package writes files, is safe.

    Raises:
        VolumeError: it is no array of three axes, is damaged, or claims more than it has or may.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        shape, dtype = _array_header(file)
        request.limit.check_array(shape, dtype, size - file.tell(), compressed=False)
    return RawScan(ScanHeader(), shape, dtype, lambda: np.load(path, mmap_mode="r", allow_pickle=False))


def read_npz(path: Path, request: ReadRequest) -> RawScan:
    """Read the header of a .npz file: the array `volume`, or the only array of three axes in it.

    Beside it, as this package writes them, `spacing_m` [3], `origin_m` [3], `frame`, `intensity_range` [2],
    `intensity_scale` and `stamp_ns`; `spacing_um` [3] serves as well as `spacing_m`. Spacings are along the axes of
    the array.

    Raises:
        VolumeError: the array is missing, is damaged, or claims more than it has or may.
    """
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        headers = {name: _member_header(archive, info) for name, info in members.items()}
        name = choose_array({key: shape for key, (shape, _) in headers.items()}, request.variable)
        shape, dtype = headers[name]
        info = members[name]
        stored = info.file_size if info.compress_type == zipfile.ZIP_STORED else info.compress_size
        request.limit.check_array(shape, dtype, stored, compressed=info.compress_type != zipfile.ZIP_STORED)
        values = {key: _value(archive, members[key]) for key in (*_HEADER_KEYS, "spacing_um") if key in members}
    spacing_um = values.pop("spacing_um", None)
    if spacing_um is not None and "spacing_m" not in values:
        values["spacing_m"] = [s * 1e-6 for s in np.atleast_1d(spacing_um).tolist()]

    def read_voxels() -> NDArray[Any]:
        with zipfile.ZipFile(path) as again, again.open(info) as file:
            array: NDArray[Any] = npy_format.read_array(file, allow_pickle=False)
            file.read(1)  # reaching its end makes zipfile check the sum of what was read
            return array

    return RawScan(ScanHeader.from_plain(values), shape, dtype, read_voxels)


def write_npz(path: Path, volume: Volume) -> None:
    """Write a C-scan as named arrays, uncompressed, without pickle.

    Raises:
        OSError: the file cannot be written.
    """
    header = {key: np.asarray(value) for key, value in ScanHeader.of(volume).to_plain().items()}
    with path.open("wb") as file:
        np.savez(file, **{VOLUME_KEY: volume.array}, **header)  # type: ignore[arg-type]


def _array_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = npy_format.read_magic(file)
    read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise VolumeError("expected numbers, got pickled objects, which are never loaded")
    return tuple(int(n) for n in shape), dtype


def _member_header(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype[Any]]:
    with archive.open(info) as file:
        return _array_header(file)  # type: ignore[arg-type]


def _value(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Any:
    shape, dtype = _member_header(archive, info)
    if math.prod(shape) * dtype.itemsize > _MAX_HEADER_VALUE_BYTES:
        raise VolumeError(f"expected a few numbers as {info.filename[:40]}, got {shape} of {dtype}")
    with archive.open(info) as file:
        return npy_format.read_array(file, allow_pickle=False).tolist()
