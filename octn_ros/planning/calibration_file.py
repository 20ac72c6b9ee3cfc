"""A calibration file as `octn calibrate` writes it: one transform new, the rest kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from octn_ros.errors import CalibrationError
from octn_ros.planning.calibration import TRANSFORMS, calibration_from_dict
from octn_ros.planning.transforms import quaternions_xyzw

_HEAD = """\
# Where the OCT probe and the laser sit on the robot's end effector. A2B maps points of frame A into frame B, in metres.
"""


def merged_calibration(
    name: str, a2b: NDArray[np.float64], residual_rms_m: float, present: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the content of a calibration file with one transform put in, as translation and quaternion.

    Args:
        name: "oct2ee" or "laser2ee".
        a2b: the transform, 4x4, metres.
        residual_rms_m: RMS of the residuals it was made with, kept beside it for the error budget of plans.
        present: content of the file it goes into; the other transform and the names of the frames stay.

    Raises:
        CalibrationError: the present content is no calibration, whole or lacking a transform.
    """
    content = dict(present or {})
    if content.setdefault("units", "m") != "m":
        raise CalibrationError(f"expected units: m in the calibration to merge into, got {content['units']}")
    content[name] = {
        "translation_m": [round(float(value), 9) for value in a2b[:3, 3]],
        "quaternion_xyzw": [round(float(value), 9) for value in quaternions_xyzw(a2b[None])[0]],
    }
    content["residual_rms_m"] = {**(content.get("residual_rms_m") or {}), name: float(f"{residual_rms_m:.4g}")}
    # A file that lacks the other transform is one to be completed; all else about it is checked already.
    calibration_from_dict({**{other: np.eye(4).tolist() for other in TRANSFORMS}, **content})
    return content


def read_calibration_content(path: Path) -> dict[str, Any] | None:
    """Return the content of a calibration file to merge into, None if there is no such file.

    Raises:
        CalibrationError: there is one, and it cannot be read or is no calibration.
    """
    if not path.exists():
        return None
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise CalibrationError(
            f"expected a calibration file to merge into at {path}, could not read it: {error}"
        ) from error
    if not isinstance(content, dict):
        raise CalibrationError(f"expected a calibration file to merge into at {path}, got {type(content).__name__}")
    return content


def calibration_text(content: dict[str, Any]) -> str:
    """Return the text of a calibration file; comments of a file it was merged from are lost."""
    return _HEAD + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
