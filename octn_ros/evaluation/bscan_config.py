"""What `octn bench bscan` is run on."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.evaluation.noise_reduction import NOISE_REDUCTIONS
from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class BscanBenchConfig:
    """Everything that decides the table besides the presets' own settings."""

    phantoms: tuple[str, ...] = setting(
        ("wavy-13dB-averaged", "wavy-13dB-single-look", "rough-13dB-averaged", "steep30-13dB-averaged"),
        "phantoms by name, where no folder of scans is given",
    )
    shape: tuple[int, int, int] = setting(
        (64, 256, 160), "voxels of every phantom (bscan, axial, lateral)", unit="voxels", low=8, high=4096
    )
    variants: tuple[str, ...] = setting(
        NOISE_REDUCTIONS, "what every scan is filtered with before the fit", choices=NOISE_REDUCTIONS
    )
    presets: tuple[str, ...] = setting(("fast", "sparse"), "presets of the fits")
    steps: int = setting(0, "gradient steps of a fit, 0 for the preset's", low=0, high=10_000_000)
    seed: int = setting(100, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = BscanBenchConfig(phantoms=("wavy-13dB-averaged", "wavy-13dB-single-look"), shape=(24, 160, 96), steps=300)
