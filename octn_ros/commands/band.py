"""`octn band`: the points of a field whose intensity lies between two levels, in a region (eq. 6)."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal
from octn_ros.commands.regions import add_regions, region_of
from octn_ros.commands.sources import FieldSource, add_source, source_of

if TYPE_CHECKING:
    from octn_ros.query import Region

SUFFIXES = (".ply", ".csv", ".npz")


@dataclass(frozen=True)
class BandCommand:
    """Find the points of one intensity band.

    Attributes:
        source: a field or C-scan file, and how to open it.
        low, high: the band; both ends belong to it.
        output: the .ply, .csv or .npz file of the points.
        region: only points inside it, None for the whole scan.
        half_open: leave `high` itself out.
        step_um: distance of the points that are looked at, None for the scan's own voxels.
        max_points: largest number of points, None for the default.
        picture: a .png file to draw them into, or None.
        json: print JSON instead of a table.
    """

    source: FieldSource
    low: float
    high: float
    output: Path
    region: Region | None = None
    half_open: bool = False
    step_um: float | None = None
    max_points: int | None = None
    picture: Path | None = None
    json: bool = False

    def run(self) -> int:
        """Find the points, write them, print how many there are; return 0.

        Raises:
            OctnError: an argument or a file cannot be used, or there are too many points.
        """
        if self.output.suffix not in SUFFIXES:
            raise terminal.CommandError(f"{self.output}: expected points to write as {', '.join(SUFFIXES)}")
        for path in filter(None, (self.output, self.picture)):
            terminal.check_output_file(path)
        from octn_ros.query import BandQuery, find_band, write_points

        given: dict[str, Any] = {"max_points": self.max_points} if self.max_points is not None else {}
        if self.step_um is not None:
            given["step_m"] = self.step_um * 1e-6
        query = BandQuery(self.low, self.high, self.half_open, **given)
        field = self.source.open()
        began = time.perf_counter()
        with terminal.ProgressBar() as bar:
            found = find_band(field, query, self.region, progress=lambda share: bar.show("searching", share))
        seconds = time.perf_counter() - began
        write_points(self.output, found.points_m, {"intensity": found.intensity}, found.description)
        if self.picture is not None:
            from octn_ros.commands.query_pictures import band_picture

            terminal.write_bytes(self.picture, band_picture(found))
        values = {
            "points": len(found.points_m),
            "searched": found.searched,
            "low": query.low,
            "high": query.high,
            "half_open": query.half_open,
            "query_s": seconds,
            "field": field.kind,
            "stamp_ns": found.description.stamp_ns,
            "file": str(self.output),
            "picture": None if self.picture is None else str(self.picture),
        }
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.source.file.name}: {query.low:g} to {query.high:g}", _rows(values))
        return 0


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser(
        "band", help="points of a field whose intensity lies between two levels", description=__doc__
    )
    add_source(parser)
    parser.add_argument("low", type=float, metavar="LOW", help="lowest intensity, 0 to 1")
    parser.add_argument("high", type=float, metavar="HIGH", help="highest intensity, 0 to 1")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the points to write: " + ", ".join(SUFFIXES)
    )
    add_regions(parser)
    parser.add_argument("--half-open", action="store_true", help="leave HIGH itself out, for bands that share no point")
    parser.add_argument("--step-um", type=float, metavar="S", help="look every S micrometres instead of at the voxels")
    parser.add_argument("--max-points", type=int, metavar="N", help="refuse an answer of more points")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the points into this .png")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> BandCommand:
    return BandCommand(
        source=source_of(arguments),
        low=arguments.low,
        high=arguments.high,
        output=arguments.output,
        region=region_of(arguments),
        half_open=arguments.half_open,
        step_um=arguments.step_um,
        max_points=arguments.max_points,
        picture=arguments.picture,
        json=arguments.json,
    )


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    end = "left out" if values["half_open"] else "included"
    return [
        ("points", f"{values['points']:,} of {values['searched']:,} that were looked at"),
        ("band", f"{values['low']:g} to {values['high']:g}, {end}"),
        ("time", f"{values['query_s']:.2f} s without opening the file"),
        ("file", values["file"]),
        *([("picture", values["picture"])] if values["picture"] else []),
    ]
