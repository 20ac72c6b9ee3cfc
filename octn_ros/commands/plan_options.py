"""The options of `octn plan` that say what is planned over, and how."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from octn_ros.commands.terminal import CommandError

Places = tuple[tuple[float, float], tuple[float, float]]

# Options that set one planner setting each: option, setting, factor to its unit, metavar, help.
_NUMBERS: tuple[tuple[str, str, float, str, str], ...] = (
    ("--line-spacing-um", "raster.line_spacing_m", 1e-6, "S", "largest distance between raster lines"),
    ("--point-spacing-um", "raster.point_spacing_m", 1e-6, "S", "largest distance between waypoints of a line"),
    ("--lead-in-um", "raster.lead_in_m", 1e-6, "L", "stretch before each line with the laser off"),
    ("--lead-out-um", "raster.lead_out_m", 1e-6, "L", "stretch after each line with the laser off"),
    ("--margin-um", "raster.margin_m", 1e-6, "M", "distance kept from the region's border, such as half a spot"),
    ("--max-tilt-deg", "waypoints.max_tilt_deg", 1.0, "A", "largest tilt of a waypoint against the beam"),
    ("--standoff-um", "waypoints.standoff_m", 1e-6, "D", "distance of the focus from the surface, towards the probe"),
    ("--depth-offset-um", "waypoints.depth_offset_m", 1e-6, "D",
     "depth of the focus below the surface as optical path, as the volume shows it"),
    ("--refractive-index", "waypoints.refractive_index", 1.0, "N", "of the tissue"),
    ("--tau", "tau", 1.0, "T", "intensity of the surface; default: estimated from the field"),
)  # fmt: skip
_WORDS: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    (
        "--spacing-along",
        "raster.point_spacing_along",
        ("surface", "lateral"),
        "what waypoint distances are measured along",
    ),
    ("--orientation", "waypoints.orientation", ("beam", "normal"), "z of a waypoint"),
    ("--standoff-along", "waypoints.standoff_along", ("pose", "beam", "normal"), "direction of the standoff"),
    ("--refinement", "search.refinement", ("newton", "least_squares", "sgd"), "how the surface is refined"),
)


def add_region(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what is planned over."""
    for name, text in (
        ("corner", "one corner of the rectangle in the OCT frame; default: the largest centred one up to 3 x 3 mm"),
        ("opposite", "the opposite corner"),
        ("centre", "centre of the rectangle in the OCT frame, in place of corners"),
        ("size", "lengths of the rectangle along and across the lines"),
    ):
        parser.add_argument(f"--{name}-mm", nargs=2, type=float, metavar=("X", "Y"), help=text)
    parser.add_argument("--polygon", type=Path, metavar="FILE", help="CSV with columns x_m, y_m: corners of a polygon")
    parser.add_argument("--angle-deg", type=float, default=0.0, metavar="A", help="angle of the lines")


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add the options that set one planner setting each."""
    parser.add_argument("--one-way", action="store_true", help="all lines in the direction of the first")
    for option, _, _, metavar, text in _NUMBERS:
        parser.add_argument(option, type=float, metavar=metavar, help=text)
    for option, _, choices, text in _WORDS:
        parser.add_argument(option, choices=choices, help=text)


def region_places(arguments: argparse.Namespace) -> tuple[str, Places]:
    """Return "corners" or "centre" and what was given of it in millimetres; "" for neither.

    Raises:
        CommandError: half a region was given, or more than one.
    """
    given = {}
    for name, first, second in (("corners", "corner_mm", "opposite_mm"), ("centre", "centre_mm", "size_mm")):
        values = [getattr(arguments, attribute) for attribute in (first, second)]
        if (values[0] is None) != (values[1] is None):
            options = [f"--{attribute.replace('_', '-')}" for attribute in (first, second)]
            raise CommandError(f"expected {options[0]} and {options[1]} together, got only one of them")
        if values[0] is not None:
            given[name] = ((values[0][0], values[0][1]), (values[1][0], values[1][1]))
    if len(given) + (arguments.polygon is not None) > 1:
        raise CommandError("expected one region: corners, centre and size, or a polygon; got several")
    return next(iter(given.items()), ("", ((0.0, 0.0), (0.0, 0.0))))


def setting_changes(arguments: argparse.Namespace) -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every planner setting that was given as an option."""
    for option, setting, factor, _, _ in _NUMBERS:
        value = getattr(arguments, option[2:].replace("-", "_"))
        if value is not None:
            yield setting, value * factor
    for option, setting, _, _ in _WORDS:
        word = getattr(arguments, option[2:].replace("-", "_"))
        if word is not None:
            yield setting, word
    if arguments.one_way:
        yield "raster.order", "one-way"
