"""Where the OCT probe and the laser sit on the robot's end effector, read from one YAML file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from octn_ros.errors import CalibrationError
from octn_ros.planning.transforms import make_rigid
from octn_ros.volume import OCT_FRAME

_TRANSFORMS = ("oct2ee", "laser2ee")
_FRAMES = ("oct_frame", "ee_frame", "base_frame", "laser_frame")
_REQUIRED = ("units", *_TRANSFORMS)


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
        deviation: how far the worse of the two rotations was from orthonormal before it was made so.

    Raises:
        CalibrationError: a transform is not rigid within 1e-3, or a frame has no name.
    """

    oct2ee: NDArray[np.float64]
    laser2ee: NDArray[np.float64]
    oct_frame: str = OCT_FRAME
    ee_frame: str = "tool0"
    base_frame: str = "base_link"
    laser_frame: str = "laser_frame"
    deviation: float = field(init=False)

    def __post_init__(self) -> None:
        deviations = []
        for name in _TRANSFORMS:
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
        content: dict with `units: m`, the 4x4 rows of `oct2ee` and `laser2ee`, and optionally names of the frames
            (`oct_frame`, `ee_frame`, `base_frame`, `laser_frame`).

    Raises:
        CalibrationError: a key is missing or unknown, the units are not metres, or a transform is not rigid.
    """
    if not isinstance(content, dict):
        raise CalibrationError(f"expected the keys {', '.join(_REQUIRED)}, got {type(content).__name__}")
    missing = [key for key in _REQUIRED if key not in content]
    unknown = sorted(str(key) for key in content if key not in (*_REQUIRED, *_FRAMES))
    if missing or unknown:
        raise CalibrationError(
            f"expected the keys {', '.join(_REQUIRED)} and optionally {', '.join(_FRAMES)}, "
            f"got missing {missing} and unknown {unknown}"
        )
    if content["units"] != "m":
        raise CalibrationError(f"expected units: m, got units: {content['units']}; write translations in metres")
    for name in _TRANSFORMS:
        _refuse_words(name, content[name])
    return Calibration(**{key: value for key, value in content.items() if key != "units"})


def _refuse_words(name: str, value: Any) -> None:
    """YAML 1.1 reads 1e-3 as a word and `yes` as true; NumPy would take both for numbers without a warning."""
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, list):
            _refuse_words(name, item)
        elif isinstance(item, bool) or not isinstance(item, (int, float)):
            raise CalibrationError(f"{name}: expected four rows of four numbers, got {item!r}; write 1.0e-3, not 1e-3")
