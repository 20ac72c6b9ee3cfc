"""Where the OCT probe and the laser sit on the robot's end effector, read from one YAML file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from octn_ros.errors import CalibrationError
from octn_ros.planning.transforms import from_translation_quaternion, make_rigid
from octn_ros.volume import OCT_FRAME

TRANSFORMS = ("oct2ee", "laser2ee")
_POSE = {"translation_m", "quaternion_xyzw"}
_FRAMES = ("oct_frame", "ee_frame", "base_frame", "laser_frame")
_REQUIRED = ("units", *TRANSFORMS)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The two fixed transforms of the platform and the names of their frames; read-only once made.

    Attributes:
        oct2ee: maps points of the OCT frame into the end-effector frame (the paper's T^EE_OCT), 4x4, metres.
        laser2ee: maps points of the laser frame (focus at the origin, z along the beam) into the end-effector frame.
        oct_frame: name of the OCT frame.
        ee_frame: name of the end-effector frame.
        base_frame: name of the robot's base frame.
        laser_frame: name of the laser frame.
        residual_rms_m: RMS of the residuals that a transform was calibrated with, in metres, by its name; a transform
            that is left out has none stated.
        deviation: how far the worse of the two rotations was from orthonormal before it was made so.

    Raises:
        CalibrationError: a transform is not rigid within 1e-3, a frame has no name, or a residual is no length.
    """

    oct2ee: NDArray[np.float64]
    laser2ee: NDArray[np.float64]
    oct_frame: str = OCT_FRAME
    ee_frame: str = "tool0"
    base_frame: str = "base_link"
    laser_frame: str = "laser_frame"
    residual_rms_m: Mapping[str, float] = field(default_factory=dict)
    deviation: float = field(init=False)

    def __post_init__(self) -> None:
        deviations = []
        for name in TRANSFORMS:
            try:
                rigid, deviation = make_rigid(getattr(self, name))
            except CalibrationError as error:
                raise CalibrationError(f"{name}: {error}") from None
            rigid.setflags(write=False)
            object.__setattr__(self, name, rigid)
            deviations.append(deviation)
        object.__setattr__(self, "deviation", max(deviations))
        for name in _FRAMES:
            if not isinstance(getattr(self, name), str) or not getattr(self, name):
                raise CalibrationError(f"{name}: expected the name of a frame, got {getattr(self, name)!r}")
        _check_residuals(self.residual_rms_m)
        object.__setattr__(self, "residual_rms_m", MappingProxyType(dict(self.residual_rms_m)))


def _check_residuals(residuals: Any) -> None:
    good = isinstance(residuals, Mapping) and all(
        name in TRANSFORMS and isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < math.inf
        for name, value in residuals.items()
    )
    if not good:
        raise CalibrationError(
            f"residual_rms_m: expected metres of at least 0 for {' or '.join(TRANSFORMS)}, got {residuals!r}"
        )


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration from a YAML file; see config/calibration.yaml for its form.

    Raises:
        CalibrationError: the file is missing or no YAML, or its content is refused by `calibration_from_dict`.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"expected a calibration file at {path}, could not read it: {error}") from error
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CalibrationError(f"expected YAML in the calibration {path}, could not parse it: {error}") from error
    try:
        return calibration_from_dict(content)
    except CalibrationError as error:
        raise CalibrationError(f"calibration {path}: {error}") from None


def calibration_from_dict(content: Any) -> Calibration:
    """Make a calibration from the content of its file.

    Args:
        content: dict with `units: m` and the transforms `oct2ee` and `laser2ee`, each as the rows of a 4x4 matrix or as
            `{translation_m: [x, y, z], quaternion_xyzw: [x, y, z, w]}`; optionally names of the frames (`oct_frame`,
            `ee_frame`, `base_frame`, `laser_frame`) and `residual_rms_m`, the RMS residual of either transform.

    Raises:
        CalibrationError: a key is missing or unknown, the units are not metres, or a transform is not rigid.
    """
    if not isinstance(content, dict):
        raise CalibrationError(f"expected the keys {', '.join(_REQUIRED)}, got {type(content).__name__}")
    missing = [key for key in _REQUIRED if key not in content]
    unknown = sorted(str(key) for key in content if key not in (*_REQUIRED, *_FRAMES, "residual_rms_m"))
    if missing or unknown:
        raise CalibrationError(
            f"expected the keys {', '.join(_REQUIRED)} and optionally {', '.join(_FRAMES)}, residual_rms_m, "
            f"got missing {missing} and unknown {unknown}"
        )
    if content["units"] != "m":
        raise CalibrationError(f"expected units: m, got units: {content['units']}; write translations in metres")
    values = {key: value for key, value in content.items() if key != "units"}
    for name in TRANSFORMS:
        values[name] = transform_from_plain(name, content[name])
    return Calibration(**values)


def transform_from_plain(name: str, value: Any) -> NDArray[np.float64]:
    """Return the 4x4 matrix of a transform as a file states it; a matrix is not yet made rigid.

    Args:
        name: of the transform, for errors.
        value: four rows of four numbers, or `{translation_m: [3], quaternion_xyzw: [4]}`, the quaternion of length 1
            within 1e-3.

    Raises:
        CalibrationError: it is neither.
    """
    if not isinstance(value, dict):
        _refuse_words(name, value, "four rows of four numbers")
        return np.array(value, dtype=np.float64) if _is_matrix(value) else value
    if set(value) != _POSE:
        raise CalibrationError(
            f"{name}: expected four rows of four numbers or {' and '.join(sorted(_POSE, reverse=True))}, "
            f"got {sorted(str(key) for key in value)}"
        )
    for key, item in value.items():
        _refuse_words(f"{name}.{key}", item, "a list of numbers")
    try:
        transform = from_translation_quaternion(value["translation_m"], value["quaternion_xyzw"])
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}") from None
    # A length other than 1 is the quaternion's deviation; as a scale it is reported like that of a matrix.
    transform[:3, :3] *= np.linalg.norm(value["quaternion_xyzw"])
    return transform


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and len({len(row) if isinstance(row, list) else -1 for row in value}) == 1


def _refuse_words(name: str, value: Any, expected: str) -> None:
    """YAML 1.1 reads 1e-3 as a word and `yes` as true; NumPy would take both for numbers without a warning."""
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, list):
            _refuse_words(name, item, expected)
        elif isinstance(item, bool) or not isinstance(item, (int, float)):
            raise CalibrationError(f"{name}: expected {expected}, got {item!r}; write 1.0e-3, not 1e-3")
