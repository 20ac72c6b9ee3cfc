"""`save_volume`: C-scans into files that keep everything a Volume knows."""

from __future__ import annotations

from pathlib import Path

from octn_ros.errors import VolumeError
from octn_ros.volume.atomic import replacing
from octn_ros.volume.formats import format_function, format_suffix
from octn_ros.volume.volume import Volume

_WRITERS = {
    ".nii": "nifti.write_nifti",
    ".nii.gz": "nifti.write_nifti",
    ".npz": "numpy_files.write_npz",
    ".tif": "tiff.write_tiff",
    ".tiff": "tiff.write_tiff",
}


def save_volume(path: str | Path, volume: Volume) -> None:
    """Write a C-scan, atomically; the suffix tells the format: .nii, .nii.gz, .npz, .tif or .tiff.

    Voxels, their type, spacing, origin, frame, intensity range, scale and stamp are read back by `load_volume` exactly
    as they were.

    Raises:
        VolumeError: the suffix is none of these, or the file cannot be written.
    """
    path = Path(path)
    suffix = format_suffix(path)
    if suffix not in _WRITERS:
        raise VolumeError(f"{path}: expected one of the suffixes {', '.join(_WRITERS)}, got {suffix or 'none'}")
    write = format_function(_WRITERS[suffix])
    try:
        with replacing(path) as temporary:
            write(temporary, volume)
    except OSError as error:
        raise VolumeError(f"{path}: cannot write the volume: {error}") from error
