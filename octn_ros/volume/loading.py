"""`load_volume` and `describe_scan`: one door for every format, with the voxels and without them."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from octn_ros.errors import OctnError, VolumeError
from octn_ros.volume.description import ScanDescription
from octn_ros.volume.formats import format_function, format_suffix
from octn_ros.volume.geometry import VolumeGeometry
from octn_ros.volume.limits import ReadLimit
from octn_ros.volume.normalisation import Normalisation
from octn_ros.volume.orientation import AXES, FORWARD, axis_order, check_scan_signs, orient
from octn_ros.volume.scan_header import RawScan, ReadRequest
from octn_ros.volume.volume import INTENSITY_SCALES, IntensityScale, Volume, integer_range, kept_type

_LOGGER = logging.getLogger(__name__)
_SPACING_TOLERANCE = 0.01  # by which a given spacing may differ from the stated one without a word

Reader = Callable[[Path, ReadRequest], RawScan]

# Format by suffix: module and function. Each module imports its library, so none is loaded before it is needed.
_READERS = {
    ".nii": "nifti.read_nifti",
    ".nii.gz": "nifti.read_nifti",
    ".npy": "numpy_files.read_npy",
    ".npz": "numpy_files.read_npz",
    ".tif": "tiff.read_tiff",
    ".tiff": "tiff.read_tiff",
    ".mat": "matlab.read_matlab",
    ".h5": "hdf5.read_hdf5",
    ".hdf5": "hdf5.read_hdf5",
    ".dcm": "dicom.read_dicom",
    ".dicom": "dicom.read_dicom",
    ".fds": "vendor.read_vendor",
    ".fda": "vendor.read_vendor",
    ".e2e": "vendor.read_vendor",
    ".oct": "vendor.read_vendor",
    ".img": "vendor.read_vendor",
}
READABLE_SUFFIXES = tuple(_READERS)
# First bytes of a file whose suffix says nothing: where they stand and what they are.
_MAGIC = (
    (344, b"n+1\0", ".nii"),
    (4, b"n+2\0", ".nii"),
    (0, b"\x1f\x8b", ".nii.gz"),
    (0, b"\x93NUMPY", ".npy"),
    (0, b"PK\x03\x04", ".npz"),
    (0, b"II*\0", ".tif"),
    (0, b"MM\0*", ".tif"),
    (0, b"II+\0", ".tif"),
    (0, b"MM\0+", ".tif"),
    (0, b"MATLAB ", ".mat"),
    (0, b"\x89HDF", ".h5"),
    (128, b"DICM", ".dcm"),
)
FORMATS = "NIfTI, .npy, .npz, TIFF, a folder of numbered images, MATLAB, HDF5, DICOM or a vendor's file"
NO_SPACING = (
    "the file does not state its spacing with a unit; give it in micrometres as --spacing-um BSCAN AXIAL LATERAL, "
    "in Python as spacing_um"
)


def load_volume(
    path: str | Path,
    spacing_um: tuple[float, float, float] | None = None,
    *,
    axes: Sequence[str] = AXES,
    scan_signs: Sequence[int] = FORWARD,
    intensity_scale: IntensityScale | None = None,
    normalisation: Normalisation | None = None,
    variable: str | None = None,
    max_bytes: int | None = None,
    max_voxels: int | None = None,
) -> Volume:
    """Read a C-scan from a file, or from a folder of numbered B-scan images; docs/volumes.md has the formats.

    Args:
        path: the file or folder. Its suffix tells the format, or its first bytes if the suffix is of no help.
        spacing_um: micrometres between voxels along (bscan, axial, lateral); overrides what the file states, with a
            warning in the log where they differ by more than 1 %.
        axes: what the axes of the file's array are, in its own order.
        scan_signs: directions of the (bscan, axial, lateral) axes; -1 for one that the scanner stores mirrored, which
            is turned round. A stated origin is that of voxel (0, 0, 0) afterwards.
        intensity_scale: overrides what the file states: linear in reflected power, or log.
        normalisation: which raw values become 0 and 1. None: as the file states it, or the range of its integer
            type, or [0, 1] for floats that lie in it, or else the smallest and the largest float.
        variable: name of the array in .npz, MATLAB and HDF5 files that hold several, or of the volume in a vendor's.
        max_bytes: the most bytes the voxels may take; None as `ReadLimit` has it.
        max_voxels: the most voxels; None for any number.

    Raises:
        VolumeError: the file is missing, empty, damaged, of no known format or too large, its spacing is unstated and
            none is given, or its voxels are unusable.
        ConfigurationError: axes or signs are none.
    """
    path = Path(path)
    order = axis_order(axes)
    check_scan_signs(scan_signs)
    with _blaming(path):
        raw = _reader(path)(path, ReadRequest(ReadLimit(max_bytes, max_voxels), variable))
        described = _described(path, raw, order, spacing_um, intensity_scale)
        voxels = raw.read_voxels()
        if voxels.shape != raw.shape:
            raise VolumeError(f"the file is damaged: its header states {raw.shape} voxels, it has {voxels.shape}")
        array = orient(voxels, order, scan_signs)
        type_range = raw.type_range or integer_range(array.dtype)
        stated = raw.header.intensity_range or type_range
        return Volume.from_array(
            array,
            described.geometry.spacing_m,
            intensity_range=normalisation.intensity_range(array, type_range) if normalisation else stated,
            intensity_scale=described.intensity_scale,
            origin_m=described.geometry.origin_m,
            stamp_ns=described.stamp_ns,
            frame=described.geometry.frame,
        )


def describe_scan(
    path: str | Path,
    spacing_um: tuple[float, float, float] | None = None,
    *,
    axes: Sequence[str] = AXES,
    intensity_scale: IntensityScale | None = None,
    variable: str | None = None,
    max_bytes: int | None = None,
    max_voxels: int | None = None,
) -> ScanDescription:
    """Tell what `load_volume` would give, from the header alone: in milliseconds, however large the file is.

    A folder of images is told by its first one, a compressed NIfTI file by its first bytes. Only vendors' formats are
    read whole. That the voxels are sound is not looked at.

    Args:
        path: the file or folder.
        spacing_um: as for `load_volume`, like the rest.
        axes: what the axes of the file's array are.
        intensity_scale: overrides what the file states.
        variable: name of the array, where the file holds several.
        max_bytes: the most bytes the voxels may take.
        max_voxels: the most voxels.

    Raises:
        VolumeError: as `load_volume`, but for what only the voxels tell.
        ConfigurationError: the axes are none.
    """
    path = Path(path)
    order = axis_order(axes)
    with _blaming(path):
        raw = _reader(path)(path, ReadRequest(ReadLimit(max_bytes, max_voxels), variable))
        return _described(path, raw, order, spacing_um, intensity_scale)


def _described(
    path: Path,
    raw: RawScan,
    order: tuple[int, int, int],
    spacing_um: tuple[float, float, float] | None,
    intensity_scale: IntensityScale | None,
) -> ScanDescription:
    if intensity_scale is not None and intensity_scale not in INTENSITY_SCALES:
        raise VolumeError(f"expected an intensity scale of {', '.join(INTENSITY_SCALES)}, got {intensity_scale!r}")
    spacing_m = _spacing_m(path, raw, order, spacing_um)
    if len(raw.shape) != 3:
        raise VolumeError(f"expected three axes [bscan, axial, lateral], got {raw.shape}")
    shape = (raw.shape[order[0]], raw.shape[order[1]], raw.shape[order[2]])
    type_range = raw.type_range or (None if raw.dtype is None else integer_range(raw.dtype))
    return ScanDescription(
        VolumeGeometry(shape, spacing_m, raw.header.origin_m, raw.header.frame),
        None if raw.dtype is None else kept_type(raw.dtype),
        raw.header.intensity_range or type_range,
        intensity_scale or raw.header.intensity_scale,
        raw.header.stamp_ns,
    )


@contextmanager
def _blaming(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong while a file is read into one error that names the file."""
    for library in ("tifffile", "pydicom"):  # what they have to say about a damaged file, the error says
        logging.getLogger(library).addHandler(_SILENT)
    try:
        with warnings.catch_warnings():
            # A damaged header makes libraries warn before they raise; the error alone is what the caller needs.
            warnings.simplefilter("ignore")
            yield
    except VolumeError as error:
        raise VolumeError(f"{path}: {error}") from error
    except OctnError:
        raise
    except MemoryError as error:
        raise VolumeError(f"{path}: the voxels do not fit into memory: {error}") from error
    except Exception as error:  # parsers of others raise anything at all when a file is damaged
        said = " ".join(str(error).split())[:300] or type(error).__name__
        raise VolumeError(f"{path}: the file is damaged, truncated or of another format: {said}") from error


_SILENT = logging.NullHandler()


def _reader(path: Path) -> Reader:
    if path.is_dir():
        return format_function("image_folder.read_image_folder")
    if not path.is_file():
        raise VolumeError(f"no such file; expected a C-scan as {FORMATS}")
    if path.stat().st_size == 0:
        raise VolumeError(f"the file is empty; expected a C-scan as {FORMATS}")
    suffix = format_suffix(path)
    if suffix not in _READERS:
        suffix = _suffix_by_content(path)
    return format_function(_READERS[suffix])


def _suffix_by_content(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(352)
    for offset, magic, suffix in _MAGIC:
        if start[offset:].startswith(magic):
            return suffix
    raise VolumeError(f"neither suffix nor content is known; expected a C-scan as {FORMATS}")


def _spacing_m(
    path: Path, raw: RawScan, order: tuple[int, int, int], spacing_um: tuple[float, float, float] | None
) -> tuple[float, float, float]:
    header = raw.header.spacing_m
    stated = None if header is None else (header[order[0]], header[order[1]], header[order[2]])
    if spacing_um is None:
        if stated is None:
            raise VolumeError(NO_SPACING)
        return stated
    bscan, axial, lateral = (float(s) * 1e-6 for s in spacing_um)
    given = bscan, axial, lateral
    if stated is not None and any(abs(g - s) > _SPACING_TOLERANCE * s for g, s in zip(given, stated, strict=True)):
        _LOGGER.warning("%s: the spacing given, %s, is taken; the file states %s", path, _text(given), _text(stated))
    return given


def _text(spacing_m: tuple[float, float, float]) -> str:
    return " x ".join(f"{spacing * 1e6:.6g}" for spacing in spacing_m) + " um"
