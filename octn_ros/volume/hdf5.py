"""C-scans in HDF5 files, MATLAB's version 7.3 among them, through h5py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.limits import check_deflated
from octn_ros.volume.named_arrays import choose_array
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader

_SPACING_KEY = "spacing_um"
_MATLAB_MARK = "MATLAB_class"
_FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32"}
_MAX_CHUNKS = 2**20
_SLAB_BYTES = 2**24


def read_hdf5(path: Path, request: ReadRequest) -> RawScan:
    """Read an HDF5 file: the dataset `volume`, or the only one of three axes at its root.

    MATLAB stores arrays with their axes reversed; where its mark is found they are turned back. A dataset `spacing_um`
    of three numbers, one for each axis of the array, states the spacing. Links to other files are not followed.

    Raises:
        VolumeError: the dataset is missing, is damaged, uses a filter that is not read, or claims more than it may.
    """
    with h5py.File(path, "r") as file:
        names = [*_dataset_names(file), *([request.variable] if request.variable else [])]
        shapes = {name: _shape(dataset) for name in names if (dataset := _dataset(file, name)) is not None}
        name = choose_array(shapes, request.variable)
        dataset = file[name]
        _check(dataset, shapes[name], path.stat().st_size, request)
        dtype = dataset.dtype.newbyteorder("=")
        stated = _dataset(file, _SPACING_KEY)
        spacing_um = _three_numbers(stated) if stated is not None else None

    def read_voxels() -> NDArray[Any]:
        with h5py.File(path, "r") as again:
            _check_chunks(again[name], path.stat().st_size, request)
            return _read(again[name])

    header = ScanHeader.from_plain({"spacing_m": spacing_um and [s * 1e-6 for s in spacing_um]})
    return RawScan(header, shapes[name], dtype, read_voxels)


def _dataset_names(file: h5py.File) -> list[str]:
    return [name for name in file if not name.startswith("#")]  # MATLAB's own groups: #refs#, #subsystem#


def _dataset(file: h5py.File, name: str) -> h5py.Dataset | None:
    """Return a dataset of real numbers; None for anything else, and for what lies behind a link to elsewhere."""
    place: Any = file
    for part in name.strip("/").split("/"):
        if not isinstance(place, h5py.Group) or not isinstance(place.get(part, getlink=True), h5py.HardLink):
            return None
        place = place[part]
    if not isinstance(place, h5py.Dataset) or place.shape is None or place.dtype.kind not in "uif":
        return None
    return place


def _is_matlab(dataset: h5py.Dataset) -> bool:
    return _MATLAB_MARK in dataset.attrs


def _shape(dataset: h5py.Dataset) -> tuple[int, ...]:
    shape = tuple(int(n) for n in dataset.shape)
    return shape[::-1] if _is_matlab(dataset) else shape


def _check(dataset: h5py.Dataset, shape: tuple[int, ...], size: int, request: ReadRequest) -> None:
    if dataset.is_virtual or dataset.external:
        raise VolumeError("expected the voxels in the file itself, got a link to other files, which is not followed")
    filters = _filters(dataset)
    if any(number not in _FILTERS for number in filters):
        raise VolumeError(f"expected the HDF5 filters {', '.join(_FILTERS.values())}, got numbers {filters}")
    compressed = bool(filters)
    stored = dataset.id.get_storage_size() if dataset.chunks else size
    request.limit.check_array(shape, dataset.dtype, min(stored, size), compressed=compressed)


def _filters(dataset: h5py.Dataset) -> list[int]:
    plan = dataset.id.get_create_plist()
    return [plan.get_filter(index)[0] for index in range(plan.get_nfilters())]


def _check_chunks(dataset: h5py.Dataset, size: int, request: ReadRequest) -> None:
    """Look at every chunk before any is expanded; those that could be bombs are read for it."""
    if not dataset.chunks:
        return
    deflated = 1 in _filters(dataset)
    chunk_bytes = int(np.prod([float(n) for n in dataset.chunks])) * dataset.dtype.itemsize
    request.limit.check(chunk_bytes, size, compressed=True)
    count = dataset.id.get_num_chunks()
    if count > _MAX_CHUNKS:
        raise VolumeError(f"expected at most {_MAX_CHUNKS} chunks, got {count}; save it with larger ones")
    for index in range(count):
        info = dataset.id.get_chunk_info(index)
        if info.size > size:
            raise VolumeError(f"the file is damaged: a chunk claims {info.size:,} bytes, the file has {size:,}")
        if deflated and not info.filter_mask:
            check_deflated(dataset.id.read_direct_chunk(info.chunk_offset)[1], chunk_bytes)


def _read(dataset: h5py.Dataset) -> NDArray[Any]:
    if not _is_matlab(dataset):
        whole: NDArray[Any] = dataset[...]
        return whole
    third, second, first = dataset.shape
    array = np.empty((first, second, third), dataset.dtype.newbyteorder("="))
    step = max(1, _SLAB_BYTES // max(1, first * second * dataset.dtype.itemsize))
    for start in range(0, third, step):
        array[..., start : start + step] = dataset[start : start + step].transpose(2, 1, 0)
    return array


def _three_numbers(dataset: h5py.Dataset) -> list[float]:
    if dataset.size != 3:
        raise VolumeError(f"expected three numbers as {_SPACING_KEY}, got a shape of {dataset.shape}")
    return [float(s) for s in np.ravel(dataset[...])]
