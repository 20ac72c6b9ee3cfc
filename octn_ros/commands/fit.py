"""`octn fit`: a C-scan file in, a fitted field out."""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal

if TYPE_CHECKING:
    from octn_ros.training import FitConfig, FitProgress

# Named here too, so that the help needs no torch; a test holds them against octn_ros.training.PRESETS.
PRESET_NAMES = ("fast", "paper")


@dataclass(frozen=True)
class FitCommand:
    """Fit a field to one C-scan file.

    Attributes:
        volume: the NIfTI file.
        output: the safetensors file to write.
        spacing_um: spacing along (bscan, axial, lateral), overrides the file's.
        preset: settings to start from.
        alpha, time_budget_s, steps, seed: override the preset's, None keeps it.
        device: auto, cpu, cuda, ...
        json: print JSON instead of a table.
    """

    volume: Path
    output: Path
    spacing_um: tuple[float, float, float] | None = None
    preset: str = "fast"
    alpha: float | None = None
    time_budget_s: float | None = None
    steps: int | None = None
    seed: int | None = None
    device: str = "auto"
    json: bool = False

    def run(self) -> int:
        """Fit, write the field, print how it went; return 0.

        Raises:
            OctnError: an argument or a file cannot be used.
        """
        terminal.check_output_file(self.output)
        from octn_ros.field import save_field
        from octn_ros.field.device import torch_device
        from octn_ros.training import fit
        from octn_ros.volume import load_volume

        config = self._config()
        device = torch_device(self.device)
        volume = load_volume(self.volume, self.spacing_um)
        with terminal.ProgressBar() as bar:

            def show(progress: FitProgress) -> None:
                bar.show("fitting the field", progress.fraction, _remark(progress))

            result = fit(volume, config, device=device, progress=show)
        save_field(self.output, result.field)
        values = {
            "field": str(self.output),
            "bytes": self.output.stat().st_size,
            "preset": self.preset,
            "device": str(device),
            "fit_s": result.seconds,
            "steps": result.steps,
            "psnr_db": result.psnr_db,
        }
        if self.json:
            terminal.print_json(values | {"config": dataclasses.asdict(config)})
        else:
            terminal.print_table(f"{self.volume.name}: fitted", _rows(values))
        return 0

    def _config(self) -> FitConfig:
        from octn_ros.training import PRESETS

        given = {
            name: getattr(self, name)
            for name in ("alpha", "time_budget_s", "steps", "seed")
            if getattr(self, name) is not None
        }
        config: FitConfig = dataclasses.replace(PRESETS[self.preset], **given)
        return config


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("fit", help="fit a field to a C-scan file", description=__doc__)
    parser.add_argument("volume", type=Path, metavar="VOLUME", help="C-scan [bscan, axial, lateral], .nii or .nii.gz")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the field to write, .safetensors"
    )
    common.add_spacing(parser)
    parser.add_argument(
        "--preset", choices=PRESET_NAMES, default="fast", help="fast: two CPU cores; paper: the paper's model, a GPU"
    )
    parser.add_argument("--alpha", type=float, help="share of interpolated samples in the hybrid stage, 0 to 1")
    parser.add_argument("--time-budget-s", type=float, metavar="S", help="end the fit after S seconds, 0 for never")
    parser.add_argument("--steps", type=int, metavar="N", help="end the fit after N gradient steps")
    parser.add_argument("--seed", type=int, metavar="N", help="of the first parameters and of all samples")
    parser.add_argument("--device", default="auto", help="auto (a GPU if there is one), cpu, cuda, cuda:1, ...")
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
        steps=arguments.steps,
        seed=arguments.seed,
        device=arguments.device,
        json=arguments.json,
    )


def _remark(progress: FitProgress) -> str:
    return f"{progress.stage}, step {progress.step}, {progress.psnr_db:.1f} dB"


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        ("fit time", f"{values['fit_s']:.1f} s on {values['device']}, preset {values['preset']}"),
        ("steps", f"{values['steps']}"),
        ("PSNR against the measured voxels", f"{values['psnr_db']:.2f} dB, 16 evenly spaced B-scans"),
        ("field", f"{values['field']}, {values['bytes'] / 1e6:.1f} MB"),
    ]
