"""What `octn bench sparse` is run on."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class SparseBenchConfig:
    """Everything that decides the table besides the preset's own settings."""

    phantoms: tuple[str, ...] = setting(
        (
            "wavy-13dB-averaged",
            "wavy-13dB-single-look",
            "rough-13dB-averaged",
            "steep30-13dB-averaged",
            "stepped-13dB-averaged",
            "wavy-13dB-single-look-grain1.2",
        ),
        "phantoms by name, where no folder of scans is given",
    )
    shape: tuple[int, int, int] = setting(
        (97, 256, 160), "voxels of every phantom (bscan, axial, lateral)", unit="voxels", low=8, high=4096
    )
    factors: tuple[int, ...] = setting((2, 4, 8, 16, 32), "the paper's SF: every so many-th B-scan is kept", low=2)
    preset: str = setting("sparse", "preset of the fits")
    steps: int = setting(0, "gradient steps of a fit, 0 for the preset's", low=0, high=10_000_000)
    seed: int = setting(100, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = SparseBenchConfig(
    phantoms=("wavy-13dB-averaged", "wavy-13dB-single-look"), shape=(49, 160, 96), factors=(2, 4, 8), steps=500
)
