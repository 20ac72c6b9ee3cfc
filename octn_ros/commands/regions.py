"""Regions of the OCT frame on the command line, in millimetres."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from octn_ros.commands.terminal import CommandError

if TYPE_CHECKING:
    from octn_ros.query import Region


def add_regions(parser: argparse.ArgumentParser) -> None:
    """Add `--box`, `--sphere`, `--polygon`; several together mean what lies in all of them."""
    parser.add_argument(
        "--box",
        nargs=6,
        type=float,
        metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
        help="only inside this box, mm of the OCT frame; inf leaves a side open",
    )
    parser.add_argument(
        "--sphere", nargs=4, type=float, metavar=("X", "Y", "Z", "RADIUS"), help="only inside this ball, mm"
    )
    parser.add_argument(
        "--polygon",
        type=Path,
        metavar="FILE",
        help="only above and below this en-face polygon: a text file of corners, each line X,Y in mm, # for comments",
    )


def region_of(arguments: argparse.Namespace) -> Region | None:
    """Return what lies in all regions that were given, None if none was.

    Raises:
        CommandError: the polygon's file cannot be read.
        QueryError: a region is none, such as a box without inside.
    """
    if arguments.box is None and arguments.sphere is None and arguments.polygon is None:
        return None
    from octn_ros.query import Box, Sphere

    regions: list[Region] = []
    if arguments.box is not None:
        x0, x1, y0, y1, z0, z1 = (side * 1e-3 for side in arguments.box)
        # argparse takes "-inf" for an option, so an open low side is written as "inf" too.
        low_x, low_y, low_z = (-math.inf if low == math.inf else low for low in (x0, y0, z0))
        regions.append(Box((low_x, low_y, low_z), (x1, y1, z1)))
    if arguments.sphere is not None:
        x, y, z, radius = (number * 1e-3 for number in arguments.sphere)
        regions.append(Sphere((x, y, z), radius))
    if arguments.polygon is not None:
        regions.append(_read_polygon(arguments.polygon))
    together = regions[0]
    for region in regions[1:]:
        together = together & region
    return together


def _read_polygon(path: Path) -> Region:
    from octn_ros.query import polygon

    corners = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: cannot read a polygon: {error}") from error
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            x, y = (float(part) * 1e-3 for part in text.replace(",", " ").split())
        except ValueError as error:
            raise CommandError(f"{path}:{number}: expected X,Y in mm, got {line.strip()!r}") from error
        corners.append((x, y))
    return polygon(corners)
