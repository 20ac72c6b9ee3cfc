"""`octn plan`: a field and a calibration in, laser waypoints in the end-effector frame out."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal
from octn_ros.commands.plan_files import read_polygon, read_pose, read_settings
from octn_ros.commands.plan_options import Places, add_region, add_settings, region_places, setting_changes
from octn_ros.commands.plan_table import plan_figures, plan_rows
from octn_ros.commands.sources import FieldSource, add_source, is_scan, source_of
from octn_ros.settings import with_setting

if TYPE_CHECKING:
    from octn_ros.field import Field
    from octn_ros.planning import Plan, PlannerConfig, Region

CSV_COLUMNS = (
    "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "segment", "laser_on", "speed_m_s", "residual", "confidence",
)  # fmt: skip


@dataclass(frozen=True)
class PlanCommand:
    """Plan a raster over the surface of one field.

    Attributes:
        source: the field file, or a C-scan file to interpolate, and how to open it.
        calibration: the YAML file with `oct2ee` and `laser2ee`.
        output: the .json or .csv file to write.
        region: "corners", "centre", or "" for the polygon or, without one, the largest centred rectangle up to
            3 x 3 mm.
        places: of the region: two corners, or centre and size, as ((x, y), (x, y)) in millimetres.
        polygon: CSV file of the region's corners.
        angle_deg: angle of the lines, and so of the rectangle, about the beam.
        changes: planner settings given as options, as (dotted name, value).
        settings: YAML file of planner settings, which the options override.
        keep_out: YAML file of keep-out regions.
        scan_pose: YAML file of the end effector's pose at the scan.
        picture: PNG file to draw the plan into.
        json: print JSON instead of a table.
    """

    source: FieldSource
    calibration: Path
    output: Path
    region: str = ""
    places: Places = ((0.0, 0.0), (0.0, 0.0))
    polygon: Path | None = None
    angle_deg: float = 0.0
    changes: tuple[tuple[str, Any], ...] = ()
    settings: Path | None = None
    keep_out: Path | None = None
    scan_pose: Path | None = None
    picture: Path | None = None
    json: bool = False

    def run(self) -> int:
        """Plan, write the plan, print how it went; return 0.

        Raises:
            OctnError: an argument or a file cannot be used, or no plan can be made.
        """
        if self.output.suffix not in (".json", ".csv"):
            raise terminal.CommandError(f"{self.output}: expected a plan to write as .json or .csv")
        if self.picture is not None and self.picture.suffix != ".png":
            raise terminal.CommandError(f"{self.picture}: expected a picture to write as .png")
        for path in (self.output, self.picture):
            if path is not None:
                terminal.check_output_file(path)
        field, plan = self._plan()
        write_plan(self.output, plan)
        values = {"plan": str(self.output), **plan_figures(plan)}
        if self.picture is not None:
            from octn_ros.commands.plan_picture import plan_picture

            terminal.write_bytes(self.picture, plan_picture(field, plan))
            values["picture"] = str(self.picture)
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.source.file.name}: planned", plan_rows(values))
        return 0

    def _plan(self) -> tuple[Field, Plan]:
        from octn_ros.field import field_hash
        from octn_ros.planning import load_calibration, load_keep_out, plan_region

        calibration = load_calibration(self.calibration)
        keep_out = load_keep_out(self.keep_out, calibration) if self.keep_out else ()
        scan_ee2base = read_pose(self.scan_pose) if self.scan_pose else None
        config = self._config()
        field = self.source.open()
        plan = plan_region(
            field,
            calibration,
            self._region(field, config.raster.line_spacing_m),
            config,
            field_hash="" if is_scan(self.source.file) else field_hash(self.source.file.read_bytes()),
            keep_out=keep_out,
            scan_ee2base=scan_ee2base,
        )
        return field, plan

    def _config(self) -> PlannerConfig:
        from octn_ros.planning import PlannerConfig

        config = read_settings(self.settings) if self.settings else PlannerConfig()
        for name, value in self.changes:
            config = with_setting(config, name, value)
        return config

    def _region(self, field: Field, line_spacing_m: float) -> Region:
        from octn_ros.demo.rectangle import centred_rectangle
        from octn_ros.planning import centred_rectangle_region, polygon_region, rectangle_region

        angle = math.radians(self.angle_deg)
        if self.polygon is not None:
            return polygon_region(read_polygon(self.polygon), angle)
        if not self.region:
            return rectangle_region(*centred_rectangle(field.geometry, angle), angle)
        first, second = (tuple(value * 1e-3 for value in place) for place in self.places)
        make_region = rectangle_region if self.region == "corners" else centred_rectangle_region
        region = make_region(first, second, angle)
        _refuse_metres(region, line_spacing_m)
        return region


def _refuse_metres(region: Region, line_spacing_m: float) -> None:
    """What is not as wide as one line spacing either way has been given in metres."""
    sides_m = [math.dist(region.vertices_m[0], region.vertices_m[corner]) for corner in (1, 3)]
    if max(sides_m) < line_spacing_m:
        raise terminal.CommandError(
            f"expected a rectangle in millimetres, with a side of {line_spacing_m * 1e6:g} um, the line spacing, or "
            f"more; got one of {sides_m[0] * 1e6:.3g} x {sides_m[1] * 1e6:.3g} um; metres are multiplied by 1000"
        )


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
    add_source(parser)
    parser.add_argument(
        "--calibration", type=Path, required=True, metavar="FILE", help="YAML with oct2ee and laser2ee, units m"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the plan to write, .json or .csv"
    )
    add_region(parser)
    add_settings(parser)
    parser.add_argument("--settings", type=Path, metavar="FILE", help="YAML of planner settings, below the options")
    parser.add_argument("--keep-out", type=Path, metavar="FILE", help="YAML of regions that the laser must not reach")
    parser.add_argument(
        "--scan-pose", type=Path, metavar="FILE", help="YAML with ee2base at the scan, for regions in the base frame"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw path and residuals, .png")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> PlanCommand:
    region, places = region_places(arguments)
    return PlanCommand(
        source=source_of(arguments),
        calibration=arguments.calibration,
        output=arguments.output,
        region=region,
        places=places,
        polygon=arguments.polygon,
        angle_deg=arguments.angle_deg,
        changes=tuple(setting_changes(arguments)),
        settings=arguments.settings,
        keep_out=arguments.keep_out,
        scan_pose=arguments.scan_pose,
        picture=arguments.picture,
        json=arguments.json,
    )
