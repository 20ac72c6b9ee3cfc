"""`octn info`: what a C-scan file holds, without torch."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal
from octn_ros.commands.reading import FILE_HELP, Reading, add_reading, reading

if TYPE_CHECKING:
    from octn_ros.volume import ScanDescription

_BAR_LENGTH = 30  # so that a line fits a terminal of 80 columns


@dataclass(frozen=True)
class InfoCommand:
    """Describe one C-scan file.

    Attributes:
        scan: the file and how to read it.
        json: print JSON instead of a table.
        header: tell what the file's header says and read no voxel.
    """

    scan: Reading
    json: bool = False
    header: bool = False

    def run(self) -> int:
        """Print the description; return 0.

        Raises:
            VolumeError: the file cannot be used.
        """
        values = self._stated(self.scan.describe()) if self.header else self._measured()
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(str(self.scan.file), _rows(values))
        return 0

    def _stated(self, told: ScanDescription) -> dict[str, Any]:
        geometry, dtype = told.geometry, told.dtype
        voxels = math.prod(geometry.shape)
        x, y, z = geometry.extent_m
        return {
            "file": str(self.scan.file),
            "axes": ["bscan", "axial", "lateral"],
            "shape": list(geometry.shape),
            "voxels": voxels,
            "dtype": None if dtype is None else str(dtype),
            "bytes": None if dtype is None else voxels * dtype.itemsize,
            "spacing_um": [s * 1e6 for s in geometry.spacing_m],
            "spacing_from": "arguments" if self.scan.spacing_um is not None else "file",
            "extent_mm": {"lateral": x * 1e3, "bscan": y * 1e3, "axial": z * 1e3},
            "origin_mm": [o * 1e3 for o in geometry.origin_m],
            "frame": geometry.frame,
            "intensity_range": told.intensity_range and list(told.intensity_range),
            "intensity_scale": told.intensity_scale,
            "stamp_ns": told.stamp_ns,
        }

    def _measured(self) -> dict[str, Any]:
        from octn_ros.volume import ScanDescription
        from octn_ros.volume.appraisal import appraise, histogram
        from octn_ros.volume.normalisation import percentiles

        volume = self.scan.load()
        geometry = volume.geometry
        counts, edges = histogram(volume)
        p1, median, p99 = percentiles(volume.array, (1.0, 50.0, 99.0))
        found = appraise(volume)
        axial_um, top_um = geometry.spacing_m[1] * 1e6, geometry.origin_m[2] * 1e6
        return self._stated(ScanDescription.of(volume)) | {
            "intensity": {
                "min": float(volume.array.min()),
                "p1": p1,
                "median": median,
                "p99": p99,
                "max": float(volume.array.max()),
            },
            "histogram": {"counts": counts.tolist(), "edges": edges.tolist()},
            "surface": {
                "median_row": found.surface_row,
                "row_range": list(found.surface_row_range),
                "median_depth_um": top_um + found.surface_row * axial_um,
                "depth_range_um": [top_um + row * axial_um for row in found.surface_row_range],
            },
            "snr_db": found.snr_db,
        }


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("info", help="describe a C-scan file", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help=FILE_HELP)
    add_reading(parser)
    parser.add_argument("--header", action="store_true", help="what the header says alone, at once for any size")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> InfoCommand:
    return InfoCommand(reading(arguments.file, arguments), arguments.json, arguments.header)


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    extent, limits = values["extent_mm"], values["intensity_range"]
    bscans, axials, laterals = values["shape"]
    kind = f" of type {values['dtype']}, {values['bytes'] / 1e6:.1f} MB" if values["dtype"] else ""
    stated = [
        ("shape", f"{bscans} B-scans x {axials} axial x {laterals} lateral"),
        ("voxels", f"{values['voxels']:,}{kind}"),
        ("spacing", " x ".join(f"{s:.6g}" for s in values["spacing_um"]) + f" um, from the {values['spacing_from']}"),
        ("extent", f"{extent['lateral']:.3f} lateral x {extent['bscan']:.3f} bscan x {extent['axial']:.3f} axial mm"),
        ("range taken as 0 to 1", f"{limits[0]:g} to {limits[1]:g}" if limits else "as the voxels have it"),
        ("scale", values["intensity_scale"]),
        ("frame", values["frame"]),
    ]
    return stated if "histogram" not in values else [*stated, *_measured_rows(values)]


def _measured_rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        ("intensity", ", ".join(f"{name} {value:g}" for name, value in values["intensity"].items())),
        ("surface", _surface_text(values["surface"])),
        ("SNR, estimated", f"{values['snr_db']:.1f} dB" if values["snr_db"] == values["snr_db"] else "not to be told"),
        ("histogram", _bars(values["histogram"])),
    ]


def _surface_text(surface: dict[str, Any]) -> str:
    rows, depths = surface["row_range"], surface["depth_range_um"]
    return (
        f"rows {rows[0]:.1f} to {rows[1]:.1f} (5% to 95%), median {surface['median_row']:.1f}; "
        f"depth {depths[0]:.0f} to {depths[1]:.0f} um"
    )


def _bars(histogram: dict[str, Any]) -> str:
    counts, edges = histogram["counts"], histogram["edges"]
    most, total = max(counts), sum(counts)
    lines = [
        f"{edge:>10.4g} {'#' * round(_BAR_LENGTH * count / most):<{_BAR_LENGTH}} {100 * count / total:5.1f}%"
        for edge, count in zip(edges[:-1], counts, strict=True)
    ]
    return "\n".join(lines)
