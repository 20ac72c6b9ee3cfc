"""C-scans in MATLAB's files: versions 5 to 7 through SciPy, version 7.3, which is HDF5, through h5py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.hdf5 import read_hdf5
from octn_ros.volume.matlab_elements import check_arrays
from octn_ros.volume.named_arrays import choose_array
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader

SPACING_KEY = "spacing_um"
# MATLAB's classes of real numbers. Others (cells, structs, objects) are never opened: they may nest without end.
_TYPES = {
    **{name: np.dtype(name) for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")},
    "single": np.dtype(np.float32),
    "double": np.dtype(np.float64),
}
_HDF5_OFFSETS = (0, 512)  # MATLAB puts 512 bytes of its own before HDF5's


def read_matlab(path: Path, request: ReadRequest) -> RawScan:
    """Read a .mat file: the array `volume`, or the only array of three axes in it, with the axes as MATLAB has them.

    A variable `spacing_um` of three numbers, one for each axis of the array, states the spacing.

    Raises:
        VolumeError: the array is missing, is damaged, or claims more than it may.
    """
    with path.open("rb") as file:
        start = file.read(_HDF5_OFFSETS[-1] + 4)
    if any(start[offset : offset + 4] == b"\x89HDF" for offset in _HDF5_OFFSETS):
        return read_hdf5(path, request)
    check_arrays(path, [])
    listed = {name: (tuple(int(n) for n in shape), kind) for name, shape, kind in scipy.io.whosmat(path)}
    numeric = {name: shape for name, (shape, kind) in listed.items() if kind in _TYPES}
    name = choose_array(numeric, request.variable)
    shape, kind = listed[name]
    # Version 7 compresses, and small integers may stand for doubles: the size of the file is no upper bound.
    request.limit.check_array(shape, _TYPES[kind], path.stat().st_size, compressed=True)
    check_arrays(path, [name, SPACING_KEY])
    spacing_um = _spacing_um(path) if SPACING_KEY in numeric else None

    def read_voxels() -> NDArray[Any]:
        array = np.asarray(scipy.io.loadmat(path, variable_names=[name])[name])
        if array.dtype.kind not in "uif":
            raise VolumeError(f"expected real intensities as {name}, got type {array.dtype}")
        return array

    header = ScanHeader.from_plain({"spacing_m": spacing_um and [s * 1e-6 for s in spacing_um]})
    return RawScan(header, shape, None, read_voxels)


def _spacing_um(path: Path) -> list[float]:
    stated = np.asarray(scipy.io.loadmat(path, variable_names=[SPACING_KEY])[SPACING_KEY])
    if stated.size != 3 or stated.dtype.kind not in "uif":
        raise VolumeError(f"expected three numbers as {SPACING_KEY}, got {stated.shape} of {stated.dtype}")
    return [float(s) for s in stated.ravel()]
