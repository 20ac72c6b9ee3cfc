"""`octn fit`: a C-scan file in, a fitted field out."""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal
from octn_ros.settings import with_setting

if TYPE_CHECKING:
    from octn_ros.field import NeuralField
    from octn_ros.training import FitConfig, FitProgress

# Named here too, so that the help needs no torch; a test holds them against octn_ros.training.PRESETS.
PRESET_NAMES = ("fast", "paper", "sparse")
ENDS = {
    "steps": "all steps done",
    "time": "time budget spent",
    "target": "target PSNR reached",
    "noise level": "error down to the noise",
    "cancelled": "cancelled; the field is unfinished",
    "diverged": "diverged; this is the last good state",
}


@dataclass(frozen=True)
class FitCommand:
    """Fit a field to one C-scan file.

    Attributes:
        volume: the C-scan file.
        output: the safetensors file to write.
        spacing_um: spacing along (bscan, axial, lateral), overrides the file's.
        preset: settings to start from.
        alpha, time_budget_s, target_psnr_db, steps, seed: override the preset's, None keeps it.
        settings: any other settings of the fit, as (path such as field.bits_per_voxel, value in YAML).
        start: a field of an earlier scan of the same geometry to begin with.
        picture: a PNG to draw.
        device: auto, cpu, cuda, ...
        json: print JSON instead of a table.
    """

    volume: Path
    output: Path
    spacing_um: tuple[float, float, float] | None = None
    preset: str = "fast"
    alpha: float | None = None
    time_budget_s: float | None = None
    target_psnr_db: float | None = None
    steps: int | None = None
    seed: int | None = None
    settings: tuple[tuple[str, str], ...] = ()
    start: Path | None = None
    picture: Path | None = None
    device: str = "auto"
    json: bool = False

    def run(self) -> int:
        """Fit, write the field, print how it went; return 0.

        Raises:
            OctnError: an argument or a file cannot be used.
        """
        for path, suffix in ((self.output, ".safetensors"), (self.picture, ".png")):
            if path is not None:
                if path.suffix.lower() != suffix:
                    raise terminal.CommandError(f"{path}: expected a file name that ends in {suffix}")
                terminal.check_output_file(path)
        from octn_ros.field import save_field
        from octn_ros.field.device import torch_device
        from octn_ros.training import fit
        from octn_ros.training.progress import PREPARING
        from octn_ros.volume import load_volume

        config = self._config()
        device = torch_device(self.device)
        start = self._start_field()
        volume = load_volume(self.volume, self.spacing_um)
        with terminal.ProgressBar() as bar:

            def show(progress: FitProgress) -> None:
                bar.show("fitting the field", progress.fraction, _remark(progress))

            bar.show(*PREPARING)
            result = fit(volume, config, device=device, progress=show, start=start)
        save_field(self.output, result.field)
        if self.picture is not None:
            from octn_ros.commands.fit_picture import fit_picture

            terminal.write_bytes(self.picture, fit_picture(volume, result.field, result.history))
        training = result.field.description.training
        values = {
            "field": str(self.output),
            "bytes": self.output.stat().st_size,
            "preset": self.preset,
            "device": str(device),
            "fit_s": result.seconds,
            "steps": result.steps,
            "samples": training["samples"],
            "backend": training["backend"],
            "ended": result.ended,
            "psnr_db": result.psnr_db,
        }
        if self.json:
            history = [dataclasses.asdict(report) for report in result.history]
            terminal.print_json(values | {"config": training["config"], "history": history})
        else:
            terminal.print_table(f"{self.volume.name}: fitted", _rows(values))
        return 0

    def _config(self) -> FitConfig:
        import yaml

        from octn_ros.training import PRESETS

        given = {
            name: getattr(self, name)
            for name in ("alpha", "time_budget_s", "target_psnr_db", "steps", "seed")
            if getattr(self, name) is not None
        }
        config: FitConfig = dataclasses.replace(PRESETS[self.preset], **given)
        for name, value in self.settings:
            config = with_setting(config, name, yaml.safe_load(value))
        return config

    def _start_field(self) -> NeuralField | None:
        if self.start is None:
            return None
        from octn_ros.field import NeuralField, load_field

        field = load_field(self.start)
        if not isinstance(field, NeuralField):
            raise terminal.CommandError(f"{self.start}: expected a neural field to start from, got a {field.kind} one")
        return field


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("fit", help="fit a field to a C-scan file", description=__doc__)
    parser.add_argument("volume", type=Path, metavar="VOLUME", help="C-scan [bscan, axial, lateral]")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the field to write, .safetensors"
    )
    common.add_spacing(parser)
    parser.add_argument(
        "--preset",
        choices=PRESET_NAMES,
        default="fast",
        help="fast: two CPU cores; paper: the paper's model, a GPU; sparse: few B-scans or much speckle",
    )
    parser.add_argument("--alpha", type=float, help="share of interpolated samples in the hybrid stage, 0 to 1")
    parser.add_argument("--time-budget-s", type=float, metavar="S", help="end the fit after S seconds, 0 for never")
    parser.add_argument(
        "--target-psnr-db", type=float, metavar="DB", help="end the fit at this PSNR on held-in voxels, 0 for never"
    )
    parser.add_argument("--steps", type=int, metavar="N", help="end the fit after N gradient steps")
    parser.add_argument("--seed", type=int, metavar="N", help="of the first parameters and of all samples")
    parser.add_argument(
        "--start", type=Path, metavar="FIELD", help="begin with this field of an earlier scan of the same geometry"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        type=_setting,
        metavar="NAME=VALUE",
        help="any other setting of the fit, such as stop_at_noise=true or field.bits_per_voxel=4; see docs/training.md",
    )
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="draw a B-scan, measured and fitted, and the PSNR curve"
    )
    common.add_device(parser)
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> FitCommand:
    return FitCommand(
        volume=arguments.volume,
        output=arguments.output,
        spacing_um=common.spacing(arguments),
        preset=arguments.preset,
        alpha=arguments.alpha,
        time_budget_s=arguments.time_budget_s,
        target_psnr_db=arguments.target_psnr_db,
        steps=arguments.steps,
        seed=arguments.seed,
        settings=tuple(arguments.set),
        start=arguments.start,
        picture=arguments.picture,
        device=arguments.device,
        json=arguments.json,
    )


def _setting(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}")
    return name, value


def _remark(progress: FitProgress) -> str:
    return f"{progress.stage}, step {progress.step}, {progress.psnr_db:.1f} dB"


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        (
            "fit time",
            f"{values['fit_s']:.1f} s on {values['device']} ({values['backend']}), preset {values['preset']}",
        ),
        ("steps", f"{values['steps']}, {values['samples'] / 1e6:.1f} M samples"),
        ("ended", ENDS[values["ended"]]),
        ("PSNR against the measured voxels", f"{values['psnr_db']:.2f} dB, 16 evenly spaced B-scans"),
        ("field", f"{values['field']}, {values['bytes'] / 1e6:.1f} MB"),
    ]
