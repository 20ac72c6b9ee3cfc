"""`octn convert`: a C-scan from one format to another, changed on the way as asked."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal
from octn_ros.commands.reading import AXES, FILE_HELP, Reading, add_reading, reading

if TYPE_CHECKING:
    from octn_ros.volume import Volume

_FILTERS = ("gaussian", "median")
_FILTER_SIZE = 3  # the paper's


@dataclass(frozen=True)
class ConvertCommand:
    """Read a C-scan, change it, write it.

    Attributes:
        scan: the file and how to read it.
        output: the file to write.
        crop: first index and the one after the last along (bscan, axial, lateral), None for all.
        subsample: keep every so many B-scans.
        log_db: turn linear intensities into decibels over this dynamic range.
        filter: gaussian or median, of size 3.
        json: print JSON instead of a table.
    """

    scan: Reading
    output: Path
    crop: tuple[tuple[int, int] | None, ...] = (None, None, None)
    subsample: int = 1
    log_db: float | None = None
    filter: str | None = None
    json: bool = False

    def run(self) -> int:
        """Convert; return 0. Steps are taken in the order of the attributes: crop, subsample, decibels, filter.

        Raises:
            OctnError: an argument or a file cannot be used.
        """
        terminal.check_output_file(self.output)
        from octn_ros.volume import save_volume

        volume = self._changed(self.scan.load())
        save_volume(self.output, volume)
        values = {
            "output": str(self.output),
            "bytes": self.output.stat().st_size,
            "dtype": str(volume.array.dtype),
            **volume.geometry.to_plain(),
            "intensity_range": list(volume.intensity_range),
            "intensity_scale": volume.intensity_scale,
        }
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.scan.file} converted", _rows(values))
        return 0

    def _changed(self, volume: Volume) -> Volume:
        from octn_ros.volume import crop, gaussian_filter_of_size, median_filter, subsample_bscans, to_log_scale

        if any(span is not None for span in self.crop):
            volume = crop(volume, *self.crop)
        if self.subsample != 1:
            volume = subsample_bscans(volume, self.subsample).volume
        if self.log_db is not None:
            volume = to_log_scale(volume, self.log_db)
        if self.filter is not None:
            smooth = gaussian_filter_of_size if self.filter == "gaussian" else median_filter
            volume = smooth(volume, _FILTER_SIZE)
        return volume


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("convert", help="turn a C-scan file into another", description=__doc__)
    parser.add_argument("file", type=Path, metavar="IN", help=FILE_HELP)
    parser.add_argument("output", type=Path, metavar="OUT", help=".nii, .nii.gz, .npz, .tif or .tiff")
    add_reading(parser)
    for axis in AXES:
        parser.add_argument(
            f"--crop-{axis}",
            nargs=2,
            type=int,
            metavar=("START", "STOP"),
            help=f"keep {axis} indices START to STOP - 1",
        )
    parser.add_argument("--subsample", type=int, default=1, metavar="SF", help="keep every SF-th B-scan")
    parser.add_argument(
        "--to-log", type=float, metavar="DB", help="linear intensities become decibels over a dynamic range of DB"
    )
    parser.add_argument("--filter", choices=_FILTERS, help="smooth, with a kernel of 3 voxels along each axis")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> ConvertCommand:
    spans = (getattr(arguments, f"crop_{axis}") for axis in AXES)
    return ConvertCommand(
        scan=reading(arguments.file, arguments),
        output=arguments.output,
        crop=tuple(None if span is None else (span[0], span[1]) for span in spans),
        subsample=arguments.subsample,
        log_db=arguments.to_log,
        filter=arguments.filter,
        json=arguments.json,
    )


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    bscans, axials, laterals = values["shape"]
    return [
        ("shape", f"{bscans} B-scans x {axials} axial x {laterals} lateral, {values['dtype']}"),
        ("spacing", " x ".join(f"{s * 1e6:.6g}" for s in values["spacing_m"]) + " um"),
        ("origin", ", ".join(f"{o * 1e3:.6g}" for o in values["origin_m"]) + f" mm in {values['frame']}"),
        ("range taken as 0 to 1", f"{values['intensity_range'][0]:g} to {values['intensity_range'][1]:g}"),
        ("scale", values["intensity_scale"]),
        ("file", f"{values['output']}, {values['bytes'] / 1e6:.1f} MB"),
    ]
