"""What a command works on: a fitted field, or a C-scan file taken as the field through its voxels."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from octn_ros.commands import arguments as common
from octn_ros.commands.terminal import CommandError

if TYPE_CHECKING:
    from octn_ros.field import Field
    from octn_ros.field.spline import InterpolationOrder

FIELD_SUFFIX = ".safetensors"


@dataclass(frozen=True)
class FieldSource:
    """A field file, or a C-scan file taken as the field that interpolates its voxels, and how to open it.

    Attributes:
        file: a field (.safetensors), or a C-scan in any format that `load_volume` reads.
        spacing_um: micrometres between voxels along (bscan, axial, lateral), for a C-scan that does not state them.
        order: how a C-scan is interpolated, trilinear if left out; a field file has its own.
        device: auto, cpu, cuda, ...
    """

    file: Path
    spacing_um: tuple[float, float, float] | None = None
    order: InterpolationOrder | None = None
    device: str = "auto"

    def open(self) -> Field:
        """Open the field.

        Raises:
            CommandError: spacing or order is given for a field file, which states both.
            CheckpointError: the field file cannot be read.
            VolumeError: the C-scan cannot be read.
            ConfigurationError: the device is not there.
        """
        from octn_ros.field import InterpolatedField, load_field
        from octn_ros.field.device import torch_device
        from octn_ros.volume import load_volume

        target = torch_device(self.device)
        if is_scan(self.file):
            return InterpolatedField(load_volume(self.file, self.spacing_um), target, self.order or "trilinear")
        for name, value in (("--spacing-um", self.spacing_um), ("--order", self.order)):
            if value is not None:
                raise CommandError(f"{self.file}: expected {name} for a C-scan only; a field file states it itself")
        return load_field(self.file, target)


def is_scan(file: Path) -> bool:
    """Return whether a file that a field is opened from is a C-scan, as its suffix tells."""
    return file.suffix != FIELD_SUFFIX


def add_field(parser: argparse.ArgumentParser) -> None:
    """Add the positional argument FIELD."""
    parser.add_argument(
        "field", type=Path, metavar="FIELD", help="a field, as `octn fit` wrote it, or a C-scan file to interpolate"
    )


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add the positional argument FIELD and the options that say how it is opened."""
    add_field(parser)
    common.add_spacing(parser)
    parser.add_argument(
        "--order", choices=("trilinear", "cubic"), help="how a C-scan is interpolated; default: trilinear"
    )
    common.add_device(parser)


def source_of(arguments: argparse.Namespace) -> FieldSource:
    """Return what `add_source`'s arguments say."""
    return FieldSource(arguments.field, common.spacing(arguments), arguments.order, arguments.device)
