"""Measurements that a calibration is made from, read from CSV or YAML; lengths in metres.

Matched points: CSV with the columns x_m, y_m, z_m (in the OCT or the laser frame) and ee_x_m, ee_y_m, ee_z_m; or YAML
with `units: m` and a list `points` of `{from: [x, y, z], ee: [x, y, z]}`.

Hand-eye poses: CSV with the columns ee_x_m, ee_y_m, ee_z_m, ee_qx, ee_qy, ee_qz, ee_qw (the end effector in the base
frame) and x_m, y_m, z_m (the fiducial in the OCT frame), with qx, qy, qz, qw if its orientation is seen too; or YAML
with `units: m` and a list `poses` of `{ee2base: ..., fiducial: ...}`, where a transform is four rows of four numbers or
`{translation_m: [3], quaternion_xyzw: [4]}`, and a fiducial is a point [x, y, z] or a transform.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from octn_ros.errors import CalibrationError
from octn_ros.planning.calibration import transform_from_plain
from octn_ros.planning.transforms import from_translation_quaternion, make_rigid

_POINT, _EE_POINT = ("x_m", "y_m", "z_m"), ("ee_x_m", "ee_y_m", "ee_z_m")
_TURN, _EE_TURN = ("qx", "qy", "qz", "qw"), ("ee_qx", "ee_qy", "ee_qz", "ee_qw")


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """Points in two frames: `points_m` [N, 3] in the OCT or the laser frame, `ee_m` [N, 3] in the end effector's."""

    points_m: NDArray[np.float64]
    ee_m: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FiducialSightings:
    """What the probe saw of a fixed fiducial.

    Attributes:
        ee2base: poses of the arm [N, 4, 4].
        fiducial: places of the fiducial in the OCT frame [N, 3], or its poses [N, 4, 4].
    """

    ee2base: NDArray[np.float64]
    fiducial: NDArray[np.float64]


def read_matched_points(path: str | Path) -> MatchedPoints:
    """Read matched points from a .csv, .yaml or .yml file; see the module for the formats.

    Raises:
        CalibrationError: the file cannot be read, or is of another form.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".csv":
            rows = _csv(path, (*_POINT, *_EE_POINT))
            return MatchedPoints(_columns(rows, _POINT), _columns(rows, _EE_POINT))
        items = _yaml_list(path, "points", {"from", "ee"})
        return MatchedPoints(*(_points([item[key] for item in items], key) for key in ("from", "ee")))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def read_fiducial_sightings(path: str | Path) -> FiducialSightings:
    """Read robot poses with what was seen of a fixed fiducial; see the module for the formats.

    Raises:
        CalibrationError: the file cannot be read, or is of another form.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".csv":
            rows = _csv(path, (*_EE_POINT, *_EE_TURN, *_POINT))
            ee2base = _poses(_columns(rows, _EE_POINT), _columns(rows, _EE_TURN))
            places = _columns(rows, _POINT)
            oriented = all(name in rows[0] for name in _TURN)
            return FiducialSightings(ee2base, _poses(places, _columns(rows, _TURN)) if oriented else places)
        items = _yaml_list(path, "poses", {"ee2base", "fiducial"})
        ee2base = np.stack([_transform(f"pose {k}: ee2base", item["ee2base"]) for k, item in enumerate(items)])
        seen = [item["fiducial"] for item in items]
        if all(isinstance(fiducial, list) and len(fiducial) == 3 for fiducial in seen):
            return FiducialSightings(ee2base, _points(seen, "fiducial"))
        return FiducialSightings(
            ee2base, np.stack([_transform(f"pose {k}: fiducial", fiducial) for k, fiducial in enumerate(seen)])
        )
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def _csv(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"expected a CSV file, could not read it: {error}") from error
    missing = [name for name in columns if not rows or name not in rows[0]]
    if missing:
        raise CalibrationError(f"expected rows with the columns {', '.join(columns)}, got none of {', '.join(missing)}")
    return rows


def _columns(rows: list[dict[str, str]], names: tuple[str, ...]) -> NDArray[np.float64]:
    try:
        return np.array([[float(row[name]) for name in names] for row in rows])
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"expected numbers in the columns {', '.join(names)}, got {error}") from None


def _yaml_list(path: Path, key: str, keys: set[str]) -> list[dict[str, Any]]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise CalibrationError(f"expected a .csv or a YAML file, could not read it: {error}") from error
    if not isinstance(content, dict):
        raise CalibrationError(
            f"expected units: m and a list {key}, got {type(content).__name__} {str(content)[:80]!r}"
        )
    if content.get("units") != "m" or not isinstance(content.get(key), list):
        raise CalibrationError(
            f"expected units: m and a list {key}, got units: {content.get('units')!r}, {key}: "
            f"{type(content.get(key)).__name__}, keys {sorted(map(str, content))}; write lengths in metres"
        )
    for number, item in enumerate(content[key]):
        if not isinstance(item, dict) or set(item) != keys:
            raise CalibrationError(f"expected {' and '.join(sorted(keys))} in item {number} of {key}, got {item!r}")
    if not content[key]:
        raise CalibrationError(f"expected a filled list {key}, got an empty one")
    return list(content[key])


def _points(rows: list[Any], what: str) -> NDArray[np.float64]:
    for number, row in enumerate(rows):
        numbers = isinstance(row, list) and [isinstance(x, (int, float)) and not isinstance(x, bool) for x in row]
        if not numbers or len(numbers) != 3 or not all(numbers):
            raise CalibrationError(f"expected {what} as [x, y, z], got {row!r} at {number}; write 1.0e-3, not 1e-3")
    return np.array(rows, dtype=np.float64)


def _poses(places: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([from_translation_quaternion(place, turn) for place, turn in zip(places, turns, strict=True)])


def _transform(name: str, value: Any) -> NDArray[np.float64]:
    try:
        return make_rigid(transform_from_plain(name, value))[0]
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}") from None
