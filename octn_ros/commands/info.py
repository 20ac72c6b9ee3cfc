"""`octn info`: what a C-scan file holds, without torch."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal


@dataclass(frozen=True)
class InfoCommand:
    """Describe one C-scan file.

    Attributes:
        file: the NIfTI file.
        spacing_um: spacing along (bscan, axial, lateral), overrides the file's.
        json: print JSON instead of a table.
    """

    file: Path
    spacing_um: tuple[float, float, float] | None = None
    json: bool = False

    def run(self) -> int:
        """Print the description; return 0.

        Raises:
            VolumeError: the file cannot be used.
        """
        values = self._describe()
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(str(self.file), _rows(values))
        return 0

    def _describe(self) -> dict[str, Any]:
        import numpy as np

        from octn_ros.volume import load_volume

        volume = load_volume(self.file, self.spacing_um)
        geometry = volume.geometry
        x, y, z = geometry.extent_m
        quantiles = np.quantile(volume.array, (0.01, 0.5, 0.99))
        return {
            "file": str(self.file),
            "axes": ["bscan", "axial", "lateral"],
            "shape": list(geometry.shape),
            "voxels": int(volume.array.size),
            "dtype": str(volume.array.dtype),
            "bytes": int(volume.array.nbytes),
            "spacing_um": [s * 1e6 for s in geometry.spacing_m],
            "spacing_from": "arguments" if self.spacing_um is not None else "file",
            "extent_mm": {"lateral": x * 1e3, "bscan": y * 1e3, "axial": z * 1e3},
            "origin_mm": [o * 1e3 for o in geometry.origin_m],
            "frame": geometry.frame,
            "intensity": {
                "min": float(volume.array.min()),
                "p1": float(quantiles[0]),
                "median": float(quantiles[1]),
                "p99": float(quantiles[2]),
                "max": float(volume.array.max()),
            },
            "intensity_range": list(volume.intensity_range),
            "intensity_scale": volume.intensity_scale,
            "stamp_ns": volume.stamp_ns,
        }


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("info", help="describe a C-scan file", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="C-scan [bscan, axial, lateral] as .nii or .nii.gz")
    common.add_spacing(parser)
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> InfoCommand:
    return InfoCommand(arguments.file, common.spacing(arguments), arguments.json)


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    extent, intensity = values["extent_mm"], values["intensity"]
    bscans, axials, laterals = values["shape"]
    return [
        ("shape", f"{bscans} B-scans x {axials} axial x {laterals} lateral"),
        ("voxels", f"{values['voxels']:,} of type {values['dtype']}, {values['bytes'] / 1e6:.1f} MB"),
        ("spacing", " x ".join(f"{s:.6g}" for s in values["spacing_um"]) + f" um, from the {values['spacing_from']}"),
        ("extent", f"{extent['lateral']:.3f} lateral x {extent['bscan']:.3f} bscan x {extent['axial']:.3f} axial mm"),
        ("intensity", ", ".join(f"{name} {value:g}" for name, value in intensity.items())),
        ("range taken as 0 to 1", f"{values['intensity_range'][0]:g} to {values['intensity_range'][1]:g}"),
        ("scale", values["intensity_scale"]),
        ("frame", values["frame"]),
    ]
