"""Arguments that several commands share."""

from __future__ import annotations

import argparse

from octn_ros.settings import check_micrometres


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add `--json`."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout, for machines")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add `--device`."""
    parser.add_argument("--device", default="auto", help="auto (a GPU if there is one), cpu, cuda, cuda:1, ...")


def add_spacing(parser: argparse.ArgumentParser) -> None:
    """Add `--spacing-um BSCAN AXIAL LATERAL`."""
    parser.add_argument(
        "--spacing-um",
        nargs=3,
        type=float,
        metavar=("BSCAN", "AXIAL", "LATERAL"),
        help="micrometres between voxels, if the file does not state them or states them wrong",
    )


def spacing(arguments: argparse.Namespace) -> tuple[float, float, float] | None:
    """Return the spacing given, in micrometres along (bscan, axial, lateral).

    Raises:
        ConfigurationError: a number is no spacing in micrometres.
    """
    if arguments.spacing_um is None:
        return None
    bscan, axial, lateral = arguments.spacing_um
    check_micrometres("--spacing-um", arguments.spacing_um)
    return bscan, axial, lateral
