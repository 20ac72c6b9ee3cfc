"""Files beside the field that `octn plan` reads: settings, a polygon, the pose of the arm at the scan."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands.terminal import CommandError
from octn_ros.errors import CalibrationError, ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from octn_ros.planning import PlannerConfig

POLYGON_COLUMNS = ("x_m", "y_m")


def read_settings(path: Path) -> PlannerConfig:
    """Read planner settings from YAML, nested as in PlannerConfig; what is left out keeps its default.

    Raises:
        CommandError: the file cannot be read, or states what no planner has.
    """
    from octn_ros.planning import PlannerConfig
    from octn_ros.settings import from_plain

    content = _yaml(path)
    if not isinstance(content, dict):
        raise CommandError(
            f"{path}: expected planner settings, such as `envelope: {{max_step_m: 0.0003}}`, got {_short(content)}"
        )
    try:
        return from_plain(PlannerConfig, content)
    except ConfigurationError as error:
        raise CommandError(f"{path}: {error}") from error


def read_polygon(path: Path) -> list[tuple[float, float]]:
    """Read the corners of a polygon in the OCT frame from a CSV file with the columns x_m and y_m, in order around it.

    Raises:
        CommandError: the file cannot be read, lacks a column, or holds something that is no number.
    """
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CommandError(f"{path}: expected a polygon as CSV, could not read it: {error}") from error
    if not rows or not set(POLYGON_COLUMNS) <= set(rows[0]):
        got = f"the columns {', '.join(map(str, rows[0]))}" if rows else "no row below a line of column names"
        raise CommandError(
            f"{path}: expected a polygon as CSV with the columns {', '.join(POLYGON_COLUMNS)}, in metres, got {got}"
        )
    try:
        return [(float(row["x_m"]), float(row["y_m"])) for row in rows]
    except (TypeError, ValueError) as error:
        raise CommandError(f"{path}: expected corners in metres, got {error}") from error


def read_pose(path: Path) -> NDArray[np.float64]:
    """Read the pose of the end effector at the time of the scan from YAML: `units: m` and `ee2base`.

    Raises:
        CommandError: the file cannot be read or states no pose in metres.
        CalibrationError: it is not rigid.
    """
    from octn_ros.planning import make_rigid
    from octn_ros.planning.calibration import transform_from_plain

    content = _yaml(path)
    if not isinstance(content, dict) or set(content) != {"units", "ee2base"} or content["units"] != "m":
        raise CommandError(
            f"{path}: expected units: m and ee2base, the pose of the end effector at the time of the scan, "
            f"got {_short(content)}"
        )
    try:
        return make_rigid(transform_from_plain("ee2base", content["ee2base"]))[0]
    except CalibrationError as error:
        raise CommandError(f"{path}: {error}") from error


def _yaml(path: Path) -> Any:
    import yaml  # here, as in `octn fit`: the other commands start without it

    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise CommandError(f"{path}: expected YAML, could not read it: {error}") from error


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 120 else text[:117] + "..."
