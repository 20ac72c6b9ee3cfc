"""What a command works on: a fitted field, or a C-scan file taken as the field through its voxels."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from octn_ros.commands import arguments as common
from octn_ros.commands.terminal import CommandError

if TYPE_CHECKING:
    import torch

    from octn_ros.field import Field

Order = Literal["trilinear", "cubic"]
FIELD_SUFFIX = ".safetensors"


def open_field(
    path: str | Path,
    spacing_um: tuple[float, float, float] | None = None,
    order: Order | None = None,
    device: str | torch.device = "auto",
) -> Field:
    """Open a field file, or a C-scan file as the field that interpolates its voxels.

    Args:
        path: a field (.safetensors), or a C-scan in any format that `load_volume` reads.
        spacing_um: micrometres between voxels along (bscan, axial, lateral), for a C-scan that does not state them.
        order: how a C-scan is interpolated, trilinear if left out; a field file has its own.
        device: auto, cpu, cuda, ... or a torch device.

    Raises:
        CommandError: spacing or order is given for a field file, which states both.
        CheckpointError: the field file cannot be read.
        VolumeError: the C-scan cannot be read.
        ConfigurationError: the device is not there.
    """
    from octn_ros.field import InterpolatedField, load_field
    from octn_ros.field.device import torch_device
    from octn_ros.volume import load_volume

    target = torch_device(device) if isinstance(device, str) else device
    path = Path(path)
    if path.suffix != FIELD_SUFFIX:
        return InterpolatedField(load_volume(path, spacing_um), target, order or "trilinear")
    for name, value in (("--spacing-um", spacing_um), ("--order", order)):
        if value is not None:
            raise CommandError(f"{path}: expected {name} for a C-scan only; a field file states it itself")
    return load_field(path, target)


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add the positional argument FIELD and the options that say how it is opened."""
    parser.add_argument(
        "field", type=Path, metavar="FIELD", help="a field, as `octn fit` wrote it, or a C-scan file to interpolate"
    )
    common.add_spacing(parser)
    parser.add_argument(
        "--order", choices=("trilinear", "cubic"), help="how a C-scan is interpolated; default: trilinear"
    )
    parser.add_argument("--device", default="auto", help="auto (a GPU if there is one), cpu, cuda, cuda:1, ...")
