"""`octn plan`: a fitted field and a calibration in, laser waypoints in the end-effector frame out."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal

if TYPE_CHECKING:
    from octn_ros.planning import Plan

CSV_COLUMNS = (
    "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "segment", "laser_on", "speed_m_s", "residual", "confidence",
)  # fmt: skip


@dataclass(frozen=True)
class PlanCommand:
    """Plan a raster over the surface of one field.

    Attributes:
        field: the safetensors file of the field.
        calibration: the YAML file with `oct2ee` and `laser2ee`.
        output: the .json or .csv file to write.
        corner_mm, opposite_mm: corners (x, y) of the rectangle in the OCT frame; None for the largest centred one.
        angle_deg: angle of the rectangle about the beam.
        line_spacing_um: distance between raster lines, None for the planner's default.
        json: print JSON instead of a table.
    """

    field: Path
    calibration: Path
    output: Path
    corner_mm: tuple[float, float] | None = None
    opposite_mm: tuple[float, float] | None = None
    angle_deg: float = 0.0
    line_spacing_um: float | None = None
    json: bool = False

    def run(self) -> int:
        """Plan, write the plan, print how it went; return 0.

        Raises:
            OctnError: an argument or a file cannot be used, or no plan can be made.
        """
        if self.output.suffix not in (".json", ".csv"):
            raise terminal.CommandError(f"{self.output}: expected a plan to write as .json or .csv")
        if (self.corner_mm is None) != (self.opposite_mm is None):
            raise terminal.CommandError("expected --corner-mm and --opposite-mm together, got only one of them")
        terminal.check_output_file(self.output)
        plan = self._plan()
        write_plan(self.output, plan)
        values = {
            "plan": str(self.output),
            "waypoints": len(plan.waypoints_ee),
            "requested": plan.requested,
            "given_up": plan.given_up,
            "tau": plan.tau,
            "hit_rate": plan.hit_rate,
            "smoothness_mm2": plan.smoothness_mm2,
            "method": plan.method,
            "seconds": plan.seconds,
            "field_hash": plan.field_hash,
        }
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.field.name}: planned", _rows(values))
        return 0

    def _plan(self) -> Plan:
        from octn_ros.demo.rectangle import centred_rectangle
        from octn_ros.field import field_hash, load_field
        from octn_ros.planning import PlannerConfig, load_calibration, plan_raster

        calibration = load_calibration(self.calibration)
        field = load_field(self.field)
        config, angle = PlannerConfig(), math.radians(self.angle_deg)
        if self.line_spacing_um is not None:
            raster = dataclasses.replace(config.raster, line_spacing_m=self.line_spacing_um * 1e-6)
            config = dataclasses.replace(config, raster=raster)
        if self.corner_mm is not None and self.opposite_mm is not None:
            corner, opposite = (tuple(value * 1e-3 for value in c) for c in (self.corner_mm, self.opposite_mm))
        else:
            corner, opposite = centred_rectangle(field.geometry, angle)
        identity = field_hash(self.field.read_bytes())
        return plan_raster(field, calibration, corner, opposite, angle, config, field_hash=identity)


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan as JSON (everything) or CSV (the waypoints in the end-effector frame).

    Raises:
        CommandError: the file cannot be written.
    """
    if path.suffix == ".json":
        from octn_ros.planning import plan_to_plain

        terminal.write_text(path, json.dumps(plan_to_plain(plan), indent=1) + "\n")
        return
    from octn_ros.planning import quaternions_xyzw

    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    columns = zip(
        plan.waypoints_ee[:, :3, 3].tolist(),
        quaternions_xyzw(plan.waypoints_ee).tolist(),
        plan.segment.tolist(),
        plan.laser_on.tolist(),
        plan.speed_m_s.tolist(),
        plan.residual.tolist(),
        plan.confidence.tolist(),
        strict=True,
    )
    for position, quaternion, segment, laser_on, *rest in columns:
        writer.writerow([*position, *quaternion, segment, int(laser_on), *rest])
    terminal.write_text(path, stream.getvalue())


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("plan", help="plan a laser raster over a field's surface", description=__doc__)
    parser.add_argument("field", type=Path, metavar="FIELD", help="the field, as `octn fit` wrote it")
    parser.add_argument(
        "--calibration", type=Path, required=True, metavar="FILE", help="YAML with oct2ee and laser2ee, units m"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the plan to write, .json or .csv"
    )
    for name, text in (("corner", "one corner"), ("opposite", "the opposite corner")):
        parser.add_argument(
            f"--{name}-mm",
            nargs=2,
            type=float,
            metavar=("X", "Y"),
            help=f"{text} of the rectangle in the OCT frame; default: the largest centred one up to 3 x 3 mm",
        )
    parser.add_argument("--angle-deg", type=float, default=0.0, metavar="A", help="angle of the rectangle")
    parser.add_argument("--line-spacing-um", type=float, metavar="S", help="distance between raster lines")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> PlanCommand:
    return PlanCommand(
        field=arguments.field,
        calibration=arguments.calibration,
        output=arguments.output,
        corner_mm=_pair(arguments.corner_mm),
        opposite_mm=_pair(arguments.opposite_mm),
        angle_deg=arguments.angle_deg,
        line_spacing_um=arguments.line_spacing_um,
        json=arguments.json,
    )


def _pair(values: list[float] | None) -> tuple[float, float] | None:
    return None if values is None else (values[0], values[1])


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        ("waypoints", f"{values['waypoints']} of {values['requested']}, {values['given_up']} given up"),
        ("hit rate", f"{100 * values['hit_rate']:.1f} % within 5 % of tau = {values['tau']:.3f}"),
        ("smoothness energy", f"{values['smoothness_mm2']:.4g} mm^2"),
        ("surface search", values["method"]),
        ("time", ", ".join(f"{name} {value:.2f} s" for name, value in values["seconds"].items())),
        ("plan", values["plan"]),
    ]
