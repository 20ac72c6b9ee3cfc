"""`octn slice`: a picture of a field: a cut in any direction, a view along the beam, or a rendering."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal
from octn_ros.commands.sources import FieldSource, add_source, source_of

if TYPE_CHECKING:
    from octn_ros.query import SliceImage

SUFFIXES = (".png", ".npy", ".tif", ".tiff")
# Named here too, so that the help needs no torch; a test holds them against octn_ros.query.slice_spec.FORMS.
SLICES = (
    "bscan:POSITION, axial:POSITION, lateral:POSITION (voxels, fractions too); enface:mip, enface:mean or "
    "enface:depth; layer:FROM,TO (mm below the surface); plane:X,Y,Z;ALONG;DOWN;WIDTH,HEIGHT[;STEP] (mm; ALONG and "
    "DOWN are directions X,Y,Z); render:AZIMUTH,ELEVATION (degrees)"
)


@dataclass(frozen=True)
class SliceCommand:
    """Take one picture of a field.

    Attributes:
        source: a field or C-scan file, and how to open it.
        slice: what to look at, see SLICES.
        output: .png for a picture with axes; .npy, .tif for the float32 values alone.
        json: print JSON instead of a table.
    """

    source: FieldSource
    slice: str
    output: Path
    json: bool = False

    def run(self) -> int:
        """Take the picture, write it, print where it lies; return 0.

        Raises:
            OctnError: an argument or a file cannot be used, or the picture lies outside the scan.
        """
        if self.output.suffix not in SUFFIXES:
            raise terminal.CommandError(f"{self.output}: expected a picture to write as {', '.join(SUFFIXES)}")
        terminal.check_output_file(self.output)
        from octn_ros.query import SliceSpec

        wanted = SliceSpec.parse(self.slice)
        field = self.source.open()
        with terminal.ProgressBar() as bar:
            image = wanted.evaluate(field, progress=lambda share: bar.show(self.slice, share))
        write_slice(self.output, image)
        values = _describe(image) | {"field": field.kind, "slice": image.specification, "file": str(self.output)}
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.source.file.name}: {image.specification}", _rows(values))
        return 0


def write_slice(path: Path, image: SliceImage) -> None:
    """Write a slice as a picture with axes (.png) or its float32 values (.npy, .tif).

    Raises:
        CommandError: the file cannot be written.
    """
    import numpy as np

    with terminal.writing(path):
        if path.suffix == ".png":
            from octn_ros.commands.query_pictures import slice_picture

            path.write_bytes(slice_picture(image))
        elif path.suffix == ".npy":
            np.save(path, image.pixels, allow_pickle=False)
        else:
            import tifffile

            tifffile.imwrite(path, image.pixels)


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("slice", help="take a picture of a field", description=__doc__)
    add_source(parser)
    parser.add_argument("slice", metavar="SLICE", help=SLICES)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the picture to write: " + ", ".join(SUFFIXES)
    )
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> SliceCommand:
    return SliceCommand(
        source=source_of(arguments),
        slice=arguments.slice,
        output=arguments.output,
        json=arguments.json,
    )


def _describe(image: SliceImage) -> dict[str, Any]:
    import numpy as np

    finite = image.pixels[np.isfinite(image.pixels)]
    spread = (float(finite.min()), float(finite.mean()), float(finite.max())) if finite.size else (float("nan"),) * 3
    return {
        "quantity": image.quantity,
        "rows": image.pixels.shape[0],
        "columns": image.pixels.shape[1],
        "missing": int(image.pixels.size - finite.size),
        **dict(zip(("min", "mean", "max"), spread, strict=True)),
        "origin_m": list(image.origin_m),
        "along_m": list(image.along_m),
        "down_m": list(image.down_m),
    }


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    def millimetres(name: str) -> str:
        return ", ".join(f"{1e3 * number:.6g}" for number in values[name])

    return [
        ("pixels", f"{values['rows']} rows x {values['columns']} columns, {values['missing']} outside the scan"),
        (values["quantity"], f"{values['min']:.6g} to {values['max']:.6g}, mean {values['mean']:.6g}"),
        ("first pixel at", f"{millimetres('origin_m')} mm of the OCT frame"),
        ("next column", f"{millimetres('along_m')} mm further"),
        ("next row", f"{millimetres('down_m')} mm further"),
        ("file", values["file"]),
    ]
