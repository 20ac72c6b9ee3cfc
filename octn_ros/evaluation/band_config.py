"""What `octn bench band` is run on."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class BandBenchConfig:
    """Everything that decides the table besides the preset's own settings."""

    phantoms: tuple[str, ...] = setting(
        ("wavy-13dB-single-look", "wavy-13dB-averaged"), "phantoms by name, where no folder of scans is given"
    )
    shape: tuple[int, int, int] = setting(
        (256, 512, 512), "voxels of every phantom (bscan, axial, lateral), the paper's", unit="voxels", low=8, high=4096
    )
    side_m: float = setting(3e-3, "sides of the mask, a column in the middle", unit="m", low=1e-5, high=0.1)
    preset: str = setting("fast", "preset of the fits")
    steps: int = setting(300, "gradient steps of a fit, 0 for the preset's", low=0, high=10_000_000)
    repeats: int = setting(3, "runs of each query of which the median counts", low=1, high=100)
    # Not 0 or another of the small numbers that settings were chosen on.
    seed: int = setting(100, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = BandBenchConfig(phantoms=("wavy-13dB-averaged",), shape=(64, 160, 192), side_m=1.2e-3, steps=100)
