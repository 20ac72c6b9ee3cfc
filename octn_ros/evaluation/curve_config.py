"""What `octn bench curve` is run on."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.evaluation.noise_reduction import NOISE_REDUCTIONS
from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class CurveBenchConfig:
    """Everything that decides the figures besides the preset's own settings."""

    phantoms: tuple[str, ...] = setting(
        (
            "wavy-13dB-averaged",
            "rough-13dB-averaged",
            "steep30-13dB-averaged",
            "wavy-13dB-single-look",
            "rough-13dB-single-look",
            "steep30-13dB-single-look",
        ),
        "phantoms by name, where no folder of scans is given",
    )
    shape: tuple[int, int, int] = setting(
        (128, 256, 256), "voxels of every phantom (bscan, axial, lateral)", unit="voxels", low=8, high=4096
    )
    preset: str = setting("fast", "preset of the fits")
    seconds: float = setting(10.0, "time budget of a fit; the paper's figure is 10 s", unit="s", low=0.1, high=1e4)
    noise_reductions: tuple[str, ...] = setting(
        NOISE_REDUCTIONS, "what every scan is filtered with before the fit", choices=NOISE_REDUCTIONS
    )
    random_rate: float = setting(
        1e-2, "learning rate of the fits that begin with random features, as Algorithm 1 does", low=1e-6, high=1.0
    )
    seed: int = setting(100, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = CurveBenchConfig(
    phantoms=("wavy-13dB-averaged", "wavy-13dB-single-look"), shape=(48, 160, 128), seconds=3.0
)  # fmt: skip
