"""`octn calibrate`: where probe or laser sit on the end effector, from matched points or from robot poses."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Named here too, so that the help needs no SciPy; a test holds them against octn_ros.planning.calibration.
TRANSFORM_NAMES = ("oct2ee", "laser2ee")


@dataclass(frozen=True)
class CalibrateCommand:
    """Make one transform of a calibration.

    Attributes:
        method: "points" (Kabsch) or "hand-eye" (AX = XB).
        data: CSV or YAML file of the measurements.
        transform: name of the transform that is made.
        output: calibration file to write; the transform is put into it if it exists. None writes nothing.
        json: print JSON instead of a table.
    """

    method: str
    data: Path
    transform: str = "oct2ee"
    output: Path | None = None
    json: bool = False

    def run(self) -> int:
        """Fit, write, print transform and residuals; return 0.

        Raises:
            OctnError: a file cannot be used, or the measurements do not determine a transform.
        """
        from octn_ros.planning.calibration_file import calibration_text, merged_calibration, read_calibration_content

        if self.output is not None:
            terminal.check_output_file(self.output)
        present = None if self.output is None else read_calibration_content(self.output)
        transform, values = self._points() if self.method == "points" else self._hand_eye()
        content = merged_calibration(self.transform, transform, values["residual_rms_m"], present)
        values = {
            "transform": self.transform,
            **content[self.transform],
            "matrix": transform.tolist(),
            **values,
            "calibration": None if self.output is None else str(self.output),
            "missing": [name for name in TRANSFORM_NAMES if name not in content],
        }
        if self.output is not None:
            terminal.write_text(self.output, calibration_text(content))
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.data.name}: {self.transform} by {self.method}", _rows(values))
        return 0

    def _points(self) -> tuple[NDArray[np.float64], dict[str, Any]]:
        from octn_ros.planning.calibration_data import read_matched_points
        from octn_ros.planning.point_fit import fit_points

        matched = read_matched_points(self.data)
        fit = fit_points(matched.points_m, matched.ee_m)
        return fit.a2b, {
            "residual_m": fit.residual_m.tolist(),
            "residual_rms_m": fit.rms_m,
            "left_out_m": fit.left_out_m.tolist(),
            "left_out_rms_m": fit.left_out_rms_m,
        }

    def _hand_eye(self) -> tuple[NDArray[np.float64], dict[str, Any]]:
        from octn_ros.planning.calibration_data import read_fiducial_sightings
        from octn_ros.planning.hand_eye import hand_eye_from_points, hand_eye_from_poses

        seen = read_fiducial_sightings(self.data)
        solve = hand_eye_from_poses if seen.fiducial.ndim == 3 else hand_eye_from_points
        fit = solve(seen.ee2base, seen.fiducial)
        values: dict[str, Any] = {"residual_m": fit.residual_m.tolist(), "residual_rms_m": fit.rms_m}
        if fit.residual_rad is not None:
            values["residual_rad"] = fit.residual_rad.tolist()
        return fit.oct2ee, {
            **values,
            "fiducial_base_m": fit.fiducial_m.tolist(),
            "translation_std_m": fit.translation_std_m,
            "rotation_std_rad": fit.rotation_std_rad,
        }


def add_parser(commands: Any) -> None:
    """Add the command and its two methods to the parser's subcommands."""
    parser = commands.add_parser(
        "calibrate", help="place probe or laser on the end effector, from measurements", description=__doc__
    )
    methods = parser.add_subparsers(dest="method", required=True, metavar="METHOD")
    points = methods.add_parser("points", help="from matched points in both frames (Kabsch)")
    points.add_argument(
        "--transform", choices=TRANSFORM_NAMES, default="oct2ee", help="which transform the points are of"
    )
    hand_eye = methods.add_parser("hand-eye", help="from robot poses with a fixed fiducial in the scan (AX = XB)")
    hand_eye.set_defaults(transform="oct2ee")
    for method in (points, hand_eye):
        method.add_argument("data", type=Path, metavar="FILE", help="measurements, .csv or .yaml; see docs/planning.md")
        method.add_argument(
            "-o", "--output", type=Path, metavar="FILE", help="calibration to write, or to put the transform into"
        )
        common.add_json(method)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> CalibrateCommand:
    return CalibrateCommand(
        method=arguments.method,
        data=arguments.data,
        transform=arguments.transform,
        output=arguments.output,
        json=arguments.json,
    )


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("translation", ", ".join(f"{value * 1e3:.4f}" for value in values["translation_m"]) + " mm"),
        ("quaternion (x, y, z, w)", ", ".join(f"{value:.6f}" for value in values["quaternion_xyzw"])),
        ("residuals", _micrometres(values["residual_m"])),
        ("their RMS", f"{values['residual_rms_m'] * 1e6:.2f} um"),
    ]
    if "left_out_m" in values:
        rows.append(("each left out", _micrometres(values["left_out_m"])))
        rows.append(("their RMS", _micrometres([values["left_out_rms_m"]])))
    if "residual_rad" in values:
        turns = ", ".join(f"{value * 1e3:.3f}" for value in values["residual_rad"])
        rows.append(("residuals of orientation", f"{turns} mrad"))
    if "rotation_std_rad" in values:
        shift, turn = values["translation_std_m"] * 1e6, values["rotation_std_rad"] * 1e3
        rows.append(("standard deviations", f"{shift:.1f} um, {turn:.3f} mrad"))
    if values["calibration"]:
        lacking = f", which still lacks {', '.join(values['missing'])}" if values["missing"] else ""
        rows.append(("calibration", values["calibration"] + lacking))
    return rows


def _micrometres(values: list[float]) -> str:
    return ", ".join("unknown" if math.isnan(value) else f"{value * 1e6:.2f}" for value in values) + " um"
