"""`octn eval`: how faithful a fitted field is to its C-scan."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import sources, terminal

if TYPE_CHECKING:
    from octn_ros.evaluation import Fidelity, GridComparison, RegionFidelity


@dataclass(frozen=True)
class EvalCommand:
    """Evaluate one field against the C-scan it was fitted to.

    Attributes:
        field: the field, or a C-scan that is interpolated.
        volume: the measured C-scan.
        truth: a noise-free C-scan of the same geometry.
        regions: YAML or JSON file of regions of interest in the middle B-scan; found automatically if None.
        spacing_um: spacing of the C-scans; the field's own if None.
        device: auto, cpu, cuda, ...
        picture: PNG file to draw, None for none.
        json: print JSON instead of a table.
    """

    field: Path
    volume: Path
    truth: Path | None = None
    regions: Path | None = None
    spacing_um: tuple[float, float, float] | None = None
    device: str = "auto"
    picture: Path | None = None
    json: bool = False

    def run(self) -> int:
        """Evaluate, draw the picture, print the figures; return 0.

        Raises:
            OctnError: an argument or a file cannot be used, or the geometries differ.
        """
        if not sources.is_scan(self.volume):
            raise terminal.CommandError(
                f"{self.volume}: expected the C-scan second, got a field; the field comes first: octn eval FIELD VOLUME"
            )
        if self.picture is not None:
            if self.picture.suffix != ".png":
                raise terminal.CommandError(f"{self.picture}: expected a picture to write as .png")
            terminal.check_output_file(self.picture)
        from octn_ros.evaluation import assess_field
        from octn_ros.metrics import load_regions
        from octn_ros.volume import load_volume

        regions = load_regions(self.regions) if self.regions is not None else None
        own_um = self.spacing_um if sources.is_scan(self.field) else None
        field = sources.FieldSource(self.field, own_um, device=self.device).open()
        # The field states its spacing, and a field is compared with its own scan: files without one need no argument.
        spacing_um = self.spacing_um or _micrometres(field.geometry.spacing_m)
        volume = load_volume(self.volume, spacing_um)
        truth = load_volume(self.truth, spacing_um) if self.truth is not None else None
        began = time.perf_counter()
        with terminal.ProgressBar() as bar:
            fidelity = assess_field(
                field,
                volume,
                truth=truth,
                regions=regions,
                progress=lambda share: bar.show("comparing B-scans", share),
            )
        values = {
            "field": str(self.field),
            "kind": field.kind,
            "volume": str(self.volume),
            "shape": list(volume.geometry.shape),
            "spacing_um": list(spacing_um),
            "device": str(field.device),
            "seconds": time.perf_counter() - began,
            **plain_fidelity(fidelity),
        }
        if self.picture is not None:
            from octn_ros.evaluation.bscan_picture import fidelity_picture

            terminal.write_bytes(self.picture, fidelity_picture(fidelity, volume.geometry))
            values["picture"] = str(self.picture)
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.field.name} against {self.volume.name}", _rows(values))
        return 0


def plain_fidelity(fidelity: Fidelity) -> dict[str, Any]:
    """Return the figures of a comparison as JSON can hold them."""
    from octn_ros.metrics import MAX_POINTS, SSIM_PARAMETERS

    slices = fidelity.fractional_db
    return {
        **_grid(fidelity.grid),
        "truth": None if fidelity.truth is None else _grid(fidelity.truth),
        "fractional_psnr_db": {f"{position:g}": value for position, value in slices.items()},
        "fractional_mean_psnr_db": sum(slices.values()) / len(slices),
        "bscan": fidelity.bscan,
        "regions": [_region(entry) for entry in fidelity.regions],
        "ssim_parameters": SSIM_PARAMETERS,
        "max_points": MAX_POINTS,
    }


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("eval", help="compare a field with its C-scan", description=__doc__)
    sources.add_field(parser)
    parser.add_argument("volume", type=Path, metavar="VOLUME", help="the measured C-scan, placed where the field lies")
    parser.add_argument("--truth", type=Path, metavar="VOLUME", help="a noise-free C-scan to compare with as well")
    parser.add_argument(
        "--rois",
        type=Path,
        metavar="FILE",
        help="YAML or JSON list of {name, kind: air|tissue|boundary, axial: [a, b], lateral: [c, d]} in voxels of the "
        "middle B-scan; default: one of each, found from the surface",
    )
    common.add_spacing(parser)
    common.add_device(parser)
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the middle B-scan as .png")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> EvalCommand:
    return EvalCommand(
        field=arguments.field,
        volume=arguments.volume,
        truth=arguments.truth,
        regions=arguments.rois,
        spacing_um=common.spacing(arguments),
        device=arguments.device,
        picture=arguments.picture,
        json=arguments.json,
    )


def _micrometres(spacing_m: tuple[float, float, float]) -> tuple[float, float, float]:
    bscan, axial, lateral = (spacing * 1e6 for spacing in spacing_m)
    return bscan, axial, lateral


def _grid(grid: GridComparison) -> dict[str, Any]:
    surfaces = [
        {"surface": name, "chamfer_um": distance.chamfer_m * 1e6, "hausdorff_um": distance.hausdorff_m * 1e6}
        for name, distance in grid.surfaces.items()
    ]
    return {
        "psnr_db": grid.psnr_db,
        "ssim": grid.ssim,
        "snr_volume_db": grid.snr_volume_db,
        "snr_field_db": grid.snr_field_db,
        "epi": grid.epi,
        "surfaces": surfaces,
    }


def _region(entry: RegionFidelity) -> dict[str, Any]:
    place = {"name": "whole", "kind": "whole"} if entry.region is None else asdict(entry.region)
    return place | {
        "psnr_db": entry.psnr_db,
        "ssim": entry.ssim,
        "snr_volume_db": entry.snr_volume_db,
        "snr_field_db": entry.snr_field_db,
        "epi": entry.epi,
        "chamfer_um": entry.surface.chamfer_m * 1e6,
        "hausdorff_um": entry.surface.hausdorff_m * 1e6,
    }


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [("global", _grid_words(values)), *_surface_rows("surface", values)]
    if values["truth"] is not None:
        rows += [("against the truth", _grid_words(values["truth"])), *_surface_rows("true surface", values["truth"])]
    slices = ", ".join(f"{position}: {value:.2f} dB" for position, value in values["fractional_psnr_db"].items())
    rows.append(("fractional B-scans", f"{slices}; mean {values['fractional_mean_psnr_db']:.2f} dB against trilinear"))
    for entry in values["regions"]:
        rows.append((f"B-scan {values['bscan']}, {entry['name']}", _region_words(entry)))
    rows.append(("time", f"{values['seconds']:.1f} s on {values['device']}, {values['kind']} field"))
    return rows


def _grid_words(values: dict[str, Any]) -> str:
    words = f"PSNR {values['psnr_db']:.2f} dB, SSIM {values['ssim']:.4f} (mean over B-scans)"
    for name, text in (
        ("snr_volume_db", ", SNR measured {:.2f} dB"),
        ("snr_field_db", ", field {:.2f} dB"),
        ("epi", ", EPI {:.3f}"),
    ):
        if math.isfinite(values[name]):  # no room for air, or air without noise as in a truth
            words += text.format(values[name])
    return words


def _surface_rows(title: str, values: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        (
            f"{title}, {entry['surface']}",
            f"Chamfer {entry['chamfer_um']:.2f} um, Hausdorff {entry['hausdorff_um']:.1f} um",
        )
        for entry in values["surfaces"]
    ]


def _region_words(entry: dict[str, Any]) -> str:
    words = [f"PSNR {entry['psnr_db']:.2f} dB"]
    for name, text in (
        ("ssim", "SSIM {:.3f}"),
        ("snr_volume_db", "SNR measured {:.2f} dB"),
        ("snr_field_db", "field {:.2f} dB"),
        ("epi", "EPI {:.3f}"),
        ("chamfer_um", "Chamfer {:.1f} um"),
    ):
        if entry[name] == entry[name]:  # NaN is a figure without meaning there
            words.append(text.format(entry[name]))
    return ", ".join(words)
