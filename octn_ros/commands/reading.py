"""Arguments about how a C-scan file is to be read."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from octn_ros.commands import arguments as common
from octn_ros.commands.terminal import CommandError

if TYPE_CHECKING:
    from octn_ros.volume import IntensityScale, Normalisation, ScanDescription, Volume

AXES = ("bscan", "axial", "lateral")
FILE_HELP = "C-scan: NIfTI, .npy, .npz, TIFF, a folder of numbered images, MATLAB, HDF5, DICOM or a vendor's file"


@dataclass(frozen=True)
class Reading:
    """A C-scan file and how to read it.

    Attributes:
        file: the file or folder.
        spacing_um: spacing along (bscan, axial, lateral), overrides the file's.
        axes: the axes of the file's array in its own order.
        scan_signs: -1 for each of (bscan, axial, lateral) that is stored mirrored.
        scale: linear or log, overrides the file's.
        normalise: type, minmax, or percentile with two numbers; None as the file states it.
        variable: which array, where the file holds several.
        max_bytes: the most bytes the voxels may take.
    """

    file: Path
    spacing_um: tuple[float, float, float] | None = None
    axes: tuple[str, ...] = AXES
    scan_signs: tuple[int, ...] = (1, 1, 1)
    scale: IntensityScale | None = None
    normalise: tuple[str, ...] | None = None
    variable: str | None = None
    max_bytes: int | None = None

    def load(self) -> Volume:
        """Read the volume.

        Raises:
            OctnError: the file or an argument cannot be used.
        """
        from octn_ros.volume import load_volume

        return load_volume(
            self.file,
            self.spacing_um,
            axes=self.axes,
            scan_signs=self.scan_signs,
            intensity_scale=self.scale,
            normalisation=self._normalisation(),
            variable=self.variable,
            max_bytes=self.max_bytes,
        )

    def describe(self) -> ScanDescription:
        """Tell what the file's header says, without its voxels.

        Raises:
            OctnError: the file or an argument cannot be used.
        """
        from octn_ros.volume import describe_scan

        if self.normalise is not None:
            raise CommandError("--normalise: the range is that of the voxels, which --header does not read")
        return describe_scan(
            self.file,
            self.spacing_um,
            axes=self.axes,
            intensity_scale=self.scale,
            variable=self.variable,
            max_bytes=self.max_bytes,
        )

    def _normalisation(self) -> Normalisation | None:
        from octn_ros.volume import Normalisation

        if self.normalise is None:
            return None
        kind, *percentiles = self.normalise
        if len(percentiles) != (2 if kind == "percentile" else 0):
            raise CommandError(
                f"--normalise: expected type, minmax or percentile LOW HIGH, got {_joined(self.normalise)}"
            )
        try:
            return Normalisation(kind, *(float(number) for number in percentiles))
        except ValueError as error:
            raise CommandError(
                f"--normalise: expected two numbers as percentiles, got {_joined(percentiles)}"
            ) from error


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add the options of a command that reads a C-scan."""
    common.add_spacing(parser)
    parser.add_argument(
        "--axes",
        nargs=3,
        metavar="AXIS",
        default=AXES,
        help="what the file's axes are, in its order: bscan axial lateral",
    )
    parser.add_argument(
        "--scan-signs",
        nargs=3,
        type=int,
        choices=(1, -1),
        default=(1, 1, 1),
        metavar=("BSCAN", "AXIAL", "LATERAL"),
        help="-1 for an axis that the scanner stores mirrored, 1 for the others",
    )
    parser.add_argument("--scale", choices=("linear", "log", "unknown"), help="what the intensities are, if unstated")
    parser.add_argument(
        "--normalise",
        nargs="+",
        metavar="HOW",
        help="which values become 0 and 1: type (range of the integers), minmax, or percentile LOW HIGH",
    )
    parser.add_argument("--variable", metavar="NAME", help="which array, if the file holds several")
    parser.add_argument("--max-bytes", type=int, metavar="N", help="the most bytes the voxels may take, if not 4 GiB")


def reading(file: Path, arguments: argparse.Namespace) -> Reading:
    """Return what the options say about a file."""
    return Reading(
        file=file,
        spacing_um=common.spacing(arguments),
        axes=tuple(arguments.axes),
        scan_signs=tuple(arguments.scan_signs),
        scale=arguments.scale,
        normalise=None if arguments.normalise is None else tuple(arguments.normalise),
        variable=arguments.variable,
        max_bytes=arguments.max_bytes,
    )


def _joined(words: tuple[str, ...] | list[str]) -> str:
    return " ".join(words) or "nothing"
