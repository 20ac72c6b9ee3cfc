"""C-scans in DICOM files of ophthalmic tomography and other multi-frame images, through pydicom."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.pixels import pixel_array
from pydicom.uid import DeflatedExplicitVRLittleEndian

from octn_ros.errors import VolumeError
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader

_LARGEST_READ_AT_ONCE = 2**16  # bytes of an element; larger ones, the voxels above all, are read when asked for
_UNDEFINED_LENGTH = 0xFFFFFFFF  # of voxels in compressed pieces
_EVEN = 1e-3  # frames whose distances differ by more than this share of them are not evenly spaced


def read_dicom(path: Path, request: ReadRequest) -> RawScan:
    """Read a multi-frame DICOM image: [frame, row, column] are its axes.

    The spacing within a frame is PixelSpacing, the one between frames SpacingBetweenSlices, both from the pixel
    measures of the shared or of all per-frame functional groups or from the data set itself, or else the even
    distance of the frames' ImagePositionPatient. SliceThickness is no distance between frames and is not taken for it.

    Raises:
        VolumeError: it is no grey multi-frame image, is damaged or compressed in a way that is not read, or claims
            more than it has or may.
    """
    # A deflated data set is inflated as a whole while it is parsed, whatever its size: refuse it before that.
    meta = pydicom.filereader.read_file_meta_info(path)
    syntax = meta.get("TransferSyntaxUID")
    if syntax == DeflatedExplicitVRLittleEndian:
        raise VolumeError("expected a transfer syntax without deflation, got Deflated Explicit VR; save it anew")
    data_set = pydicom.dcmread(path, defer_size=_LARGEST_READ_AT_ONCE)
    if "PixelData" not in data_set:
        raise VolumeError("expected a DICOM image, it has no PixelData")
    if data_set.get("SamplesPerPixel", 1) != 1:
        raise VolumeError(f"expected a grey image, got {data_set.SamplesPerPixel} samples per pixel")
    shape = tuple(int(data_set.get(name, 1)) for name in ("NumberOfFrames", "Rows", "Columns"))
    if shape[0] == 1:
        raise VolumeError(f"expected a frame for each B-scan, got one frame of {shape[1]} x {shape[2]}")
    bits = int(data_set.BitsAllocated)
    if bits not in (8, 16, 32):
        raise VolumeError(f"expected 8, 16 or 32 bits for each voxel, got {bits}")
    dtype = np.dtype(f"{'i' if data_set.get('PixelRepresentation', 0) else 'u'}{bits // 8}")
    compressed = bool(syntax is not None and syntax.is_compressed)
    request.limit.check_array(shape, dtype, _stored_bytes(data_set, path), compressed=compressed)
    groups = _functional_groups(data_set)
    slope, intercept = _rescale(data_set, groups)

    def read_voxels() -> NDArray[Any]:
        array = pixel_array(data_set, raw=True, view_only=True)
        if (slope, intercept) == (1.0, 0.0):
            return array
        return (array * np.float32(slope) + np.float32(intercept)).astype(np.float32, copy=False)

    header = ScanHeader(
        spacing_m=_spacing_m(data_set, groups, shape[0]),
        intensity_range=_stored_range(data_set, slope, intercept),
        stamp_ns=_stamp_ns(data_set),
    )
    scaled = (slope, intercept) != (1.0, 0.0)
    return RawScan(header, shape, np.dtype(np.float32) if scaled else dtype, read_voxels, header.intensity_range)


def _stored_bytes(data_set: Any, path: Path) -> int:
    """Return how many bytes the file has for the voxels, as far as that can be told without reading them."""
    element = data_set.get_item("PixelData", keep_deferred=True)
    length = getattr(element, "length", None)  # none of an element that was read at once
    if length is None:
        return len(element.value)
    start = element.value_tell
    left = max(0, path.stat().st_size - start)
    return left if length == _UNDEFINED_LENGTH else min(length, left)


def _functional_groups(data_set: Any) -> list[Any]:
    """Return the groups that hold for all frames, and after them those of each frame."""
    return [*data_set.get("SharedFunctionalGroupsSequence", []), *data_set.get("PerFrameFunctionalGroupsSequence", [])]


def _stated(data_set: Any, groups: list[Any], sequence: str, name: str) -> Any:
    """Return the one value of an attribute in all groups that have it, or in the data set; None if there is none.

    Raises:
        VolumeError: it differs from frame to frame.
    """
    values = [item.get(name) for group in groups for item in group.get(sequence, [])]
    values = [value for value in values if value is not None]
    if any(value != values[0] for value in values[1:]):
        raise VolumeError(f"expected one {name} for all frames, it changes from frame to frame")
    return values[0] if values else data_set.get(name)


def _spacing_m(data_set: Any, groups: list[Any], frames: int) -> tuple[float, float, float] | None:
    within = _stated(data_set, groups, "PixelMeasuresSequence", "PixelSpacing")
    between = _stated(data_set, groups, "PixelMeasuresSequence", "SpacingBetweenSlices")
    distance = float(between) if between is not None else _frame_distance(groups, frames)
    if within is None or distance is None:
        return None
    row, column = (float(value) for value in within)  # the distance of rows, then of columns, in millimetres
    return distance * 1e-3, row * 1e-3, column * 1e-3


def _frame_distance(groups: list[Any], frames: int) -> float | None:
    positions = [
        [float(value) for value in item.ImagePositionPatient]
        for group in groups
        for item in group.get("PlanePositionSequence", [])
        if "ImagePositionPatient" in item
    ]
    if len(positions) != frames or frames < 2:
        return None
    steps = np.diff(np.array(positions), axis=0)
    mean = steps.mean(axis=0)
    distance = float(np.linalg.norm(mean))
    if np.linalg.norm(steps - mean, axis=1).max() > _EVEN * distance:
        raise VolumeError("expected frames at even distances, ImagePositionPatient places them unevenly")
    return distance


def _rescale(data_set: Any, groups: list[Any]) -> tuple[float, float]:
    sequence = "PixelValueTransformationSequence"
    slope = _stated(data_set, groups, sequence, "RescaleSlope")
    intercept = _stated(data_set, groups, sequence, "RescaleIntercept")
    values = (1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept))
    if not all(math.isfinite(value) for value in values) or values[0] == 0:
        raise VolumeError(f"expected a finite rescaling of the intensities, got slope and intercept {values}")
    return values


def _stored_range(data_set: Any, slope: float, intercept: float) -> tuple[float, float]:
    stored = int(data_set.get("BitsStored", data_set.BitsAllocated))
    if not 1 <= stored <= int(data_set.BitsAllocated):
        raise VolumeError(f"expected 1 to {data_set.BitsAllocated} bits stored, got {stored}")
    low = -(2 ** (stored - 1)) if data_set.get("PixelRepresentation", 0) else 0
    ends = sorted(value * slope + intercept for value in (low, low + 2**stored - 1))
    return ends[0], ends[1]


def _stamp_ns(data_set: Any) -> int:
    """Return the acquisition time, 0 if it is unstated or without an offset from UTC."""
    stated = data_set.get("AcquisitionDateTime")
    moment = pydicom.valuerep.DT(stated) if stated else None
    if moment is None or moment.tzinfo is None:
        return 0
    return max(0, int(moment.timestamp()) * 10**9 + moment.microsecond * 1000)
