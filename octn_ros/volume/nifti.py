"""C-scans in NIfTI files, through nibabel."""

from __future__ import annotations

import dataclasses
import gzip
import math
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any, BinaryIO

import nibabel
import numpy as np
from nibabel.nifti1 import Nifti1Extension
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.geometry import VolumeGeometry
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader
from octn_ros.volume.slabs import read_fortran_order
from octn_ros.volume.volume import Volume, integer_range, kept_type

_METRES_PER_UNIT = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6}
# Intensity range, scale and acquisition time have no field in the NIfTI header: they travel as JSON in a comment.
_COMMENT_CODE = 6
_MAX_HEADER_BYTES = 2**24  # extensions are comments; a header that claims more is damaged
_SPACING_ROUNDING = 1e-6  # NIfTI keeps spacings in single precision


def read_nifti(path: Path, request: ReadRequest) -> RawScan:
    """Read the header of a .nii or .nii.gz file.

    Raises:
        VolumeError: the file is no NIfTI, is damaged, or claims more than it has or may.
    """
    compressed = _is_gzip(path)
    with _opened(path, compressed) as file:
        header, comment = _read_header(file)
    shape = _three_axes(tuple(int(n) for n in header.get_data_shape()))
    stored_type = header.get_data_dtype()
    offset, size = int(header.get_data_offset()), path.stat().st_size
    stored = size if compressed else max(0, size - offset)
    request.limit.check_array(shape, stored_type, stored, compressed=compressed)
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    if not (math.isfinite(slope) and slope != 0):  # as the standard has it: the scaling is not used
        slope, intercept = 1.0, 0.0
    if not math.isfinite(intercept):
        raise VolumeError(f"expected a finite intercept of the intensities, got {intercept}")
    scaled = (slope, intercept) != (1.0, 0.0)
    dtype = np.dtype(np.float32) if scaled else kept_type(stored_type)

    def read_voxels() -> NDArray[Any]:
        array = np.empty(shape, dtype)
        with _opened(path, compressed) as file:
            _skip(file, offset)

            def convert(slab: NDArray[Any]) -> NDArray[Any]:
                return slab * slope + intercept if scaled else slab

            read_fortran_order(file, stored_type, array, convert)
            file.read(1)  # reaching its end makes gzip check the sum of what was read
        return array

    type_range = None if scaled else integer_range(stored_type)
    return RawScan(_scan_header(header, comment), shape, dtype, read_voxels, type_range)


def write_nifti(path: Path, volume: Volume) -> None:
    """Write a C-scan with its spacing in millimetres, place, intensity range and scale.

    Raises:
        OSError: the file cannot be written.
    """
    image = nibabel.Nifti1Image(volume.array, _affine_mm(volume.geometry))
    image.header.set_xyzt_units("mm")
    image.header.extensions.append(Nifti1Extension(_COMMENT_CODE, ScanHeader.of(volume).to_json().encode()))
    nibabel.save(image, path)


def _is_gzip(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def _opened(path: Path, compressed: bool) -> Any:
    return closing(gzip.open(path) if compressed else path.open("rb"))


def _read_header(file: BinaryIO) -> tuple[Any, ScanHeader | None]:
    """Return nibabel's header and our comment.

    nibabel's own way to the extensions reads as much as a damaged one claims, hence the walk through them here.
    """
    try:
        block = file.read(540)
    except (OSError, EOFError, zlib.error) as error:
        raise VolumeError(f"the file is damaged or truncated: {error}") from error
    size = next((n for n in (348, 540) if block[:4] in (n.to_bytes(4, "little"), n.to_bytes(4, "big"))), 0)
    if not size:
        raise VolumeError("expected a NIfTI file (.nii or .nii.gz), got something else")
    if len(block) < size:
        raise VolumeError("the file is damaged or truncated: it ends within the NIfTI header")
    kind = nibabel.Nifti1Header if size == 348 else nibabel.Nifti2Header
    try:
        # Unchecked, for nibabel's check would turn a spacing of zero into one.
        header = kind(block[:size], check=False)
    except (nibabel.spatialimages.HeaderDataError, ValueError, OverflowError) as error:
        raise VolumeError(f"expected a NIfTI file (.nii or .nii.gz), its header is damaged: {error}") from error
    if bytes(header["magic"])[:3] not in (b"n+1", b"n+2"):
        raise VolumeError("expected a NIfTI file in one piece (.nii or .nii.gz), with the magic n+1 or n+2")
    offset = header["vox_offset"]
    if not size + 4 <= offset <= _MAX_HEADER_BYTES:
        raise VolumeError(f"expected voxels at byte {size + 4} to {_MAX_HEADER_BYTES} of a NIfTI file, got {offset}")
    extensions = (block[size:] + file.read(max(0, int(offset) - len(block))))[4 : int(offset) - size]
    return header, _comment(extensions, header.endianness)


def _comment(extensions: bytes, endianness: str) -> ScanHeader | None:
    order = "little" if endianness == "<" else "big"
    while len(extensions) >= 16:
        size, code = (int.from_bytes(extensions[i : i + 4], order, signed=True) for i in (0, 4))  # type: ignore[arg-type]
        if not 8 < size <= len(extensions):
            return None
        if code == _COMMENT_CODE:
            stated = ScanHeader.from_json(extensions[8:size].rstrip(b"\0"))
            if stated is not None:
                return stated
        extensions = extensions[size:]
    return None


def _three_axes(shape: tuple[int, ...]) -> tuple[int, int, int]:
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        raise VolumeError(f"expected three axes [bscan, axial, lateral], got {shape}")
    return shape


def _skip(file: BinaryIO, count: int) -> None:
    if len(file.read(count)) < count:
        raise VolumeError("the file is damaged or truncated: it ends before its voxels")


def _scan_header(header: Any, comment: ScanHeader | None) -> ScanHeader:
    stated = comment or ScanHeader()
    metres, exact = _METRES_PER_UNIT.get(header.get_xyzt_units()[0]), stated.spacing_m
    spacing = tuple(abs(float(z)) * metres for z in header.get_zooms()[:3]) if metres is not None else None
    if exact and spacing and all(abs(a - b) <= _SPACING_ROUNDING * abs(b) for a, b in zip(exact, spacing, strict=True)):
        spacing = exact
    return dataclasses.replace(stated, spacing_m=spacing)  # type: ignore[arg-type]


def _affine_mm(geometry: VolumeGeometry) -> NDArray[np.float64]:
    (bscan, axial, lateral), origin = geometry.spacing_m, geometry.origin_m
    affine = np.eye(4)
    affine[:3, :3] = [[0, 0, lateral], [bscan, 0, 0], [0, axial, 0]]
    affine[:3, 3] = origin
    affine[:3] *= 1e3
    return affine
