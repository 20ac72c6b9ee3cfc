"""C-scans in NIfTI files, through nibabel."""

from __future__ import annotations

import json
import warnings
import zlib
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from nibabel.nifti1 import Nifti1Extension
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.geometry import OCT_FRAME, VolumeGeometry
from octn_ros.volume.volume import Volume

_METRES_PER_UNIT = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6}
# Intensity range, scale and acquisition time have no field in the NIfTI header: they travel as JSON in a comment.
_COMMENT_CODE = 6
_COMMENT_KEY = "octn_volume"


def load_volume(path: str | Path, spacing_um: tuple[float, float, float] | None = None) -> Volume:
    """Read a C-scan from a NIfTI file (.nii or .nii.gz) whose axes are [bscan, axial, lateral].

    Args:
        path: the file.
        spacing_um: micrometres between voxels along (bscan, axial, lateral); overrides what the file states.

    Raises:
        VolumeError: the file is missing, empty, truncated or no NIfTI, its spacing is unstated and none is given, or
            its voxels are unusable.
    """
    path = Path(path)
    if not path.is_file():
        raise VolumeError(f"{path}: no such file; expected a C-scan as .nii or .nii.gz")
    if path.stat().st_size == 0:
        raise VolumeError(f"{path}: the file is empty; expected a C-scan as .nii or .nii.gz")
    try:
        image, array = _read(path)
    except (nibabel.filebasedimages.ImageFileError, nibabel.spatialimages.HeaderDataError) as error:
        raise VolumeError(f"{path}: expected a NIfTI file (.nii or .nii.gz), got something else: {error}") from error
    except (OSError, EOFError, ValueError, OverflowError, zlib.error) as error:
        raise VolumeError(f"{path}: the file is damaged or truncated: {error}") from error
    if array.ndim == 4 and array.shape[3] == 1:
        array = array[..., 0]
    if array.ndim != 3:
        raise VolumeError(f"{path}: expected three axes [bscan, axial, lateral], got {array.shape}")
    stated = _read_comment(image)
    try:
        volume = Volume.from_array(
            array,
            _spacing_m(image, spacing_um),
            intensity_range=tuple(stated["intensity_range"]) if "intensity_range" in stated else None,
            intensity_scale=stated.get("intensity_scale", "unknown"),
            origin_m=tuple(stated.get("origin_m", (0.0, 0.0, 0.0))),
            stamp_ns=int(stated.get("stamp_ns", 0)),
        )
    except VolumeError as error:
        raise VolumeError(f"{path}: {error}") from error
    return volume


def save_volume(path: str | Path, volume: Volume) -> None:
    """Write a C-scan as NIfTI with its spacing in millimetres, place, intensity range and scale.

    Raises:
        VolumeError: the file cannot be written.
    """
    geometry = volume.geometry
    image = nibabel.Nifti1Image(volume.array, _affine_mm(geometry))
    image.header.set_xyzt_units("mm")
    comment = {
        "intensity_range": list(volume.intensity_range),
        "intensity_scale": volume.intensity_scale,
        "origin_m": list(geometry.origin_m),
        "frame": geometry.frame,
        "stamp_ns": volume.stamp_ns,
    }
    content = json.dumps({_COMMENT_KEY: comment}).encode()
    image.header.extensions.append(Nifti1Extension(_COMMENT_CODE, content))
    try:
        nibabel.save(image, path)
    except (OSError, nibabel.filebasedimages.ImageFileError) as error:
        raise VolumeError(f"{path}: cannot write the volume: {error}") from error


def _read(path: Path) -> tuple[Any, NDArray[Any]]:
    with warnings.catch_warnings():
        # A damaged header can make nibabel warn before it raises; the error alone is what the caller needs.
        warnings.simplefilter("ignore")
        image = nibabel.load(path)
        if not isinstance(image, nibabel.Nifti1Pair):  # Nifti2 derives from it
            raise nibabel.filebasedimages.ImageFileError(f"a {type(image).__name__}")
        return image, np.asanyarray(image.dataobj)


def _spacing_m(image: Any, spacing_um: tuple[float, float, float] | None) -> tuple[float, float, float]:
    if spacing_um is not None:
        bscan, axial, lateral = (float(s) * 1e-6 for s in spacing_um)
        return bscan, axial, lateral
    unit = image.header.get_xyzt_units()[0]
    if unit not in _METRES_PER_UNIT:
        raise VolumeError(
            "the file does not state the unit of its spacing; give it in micrometres as "
            "--spacing-um BSCAN AXIAL LATERAL, in Python as spacing_um"
        )
    bscan, axial, lateral = (float(z) * _METRES_PER_UNIT[unit] for z in image.header.get_zooms()[:3])
    return bscan, axial, lateral


def _affine_mm(geometry: VolumeGeometry) -> NDArray[np.float64]:
    (bscan, axial, lateral), origin = geometry.spacing_m, geometry.origin_m
    affine = np.eye(4)
    affine[:3, :3] = [[0, 0, lateral], [bscan, 0, 0], [0, axial, 0]]
    affine[:3, 3] = origin
    affine[:3] *= 1e3
    return affine


def _read_comment(image: Any) -> dict[str, Any]:
    for extension in image.header.extensions:
        if extension.get_code() == _COMMENT_CODE:
            try:
                content = json.loads(bytes(extension.content).rstrip(b"\0"))
            except ValueError:
                continue
            stated = content.get(_COMMENT_KEY) if isinstance(content, dict) else None
            if isinstance(stated, dict) and stated.get("frame", OCT_FRAME) == OCT_FRAME:
                return stated
    return {}
