"""What `octn bench slices` is run on."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class SlicesBenchConfig:
    """Everything that decides the table besides the presets' own settings."""

    phantoms: tuple[str, ...] = setting(
        ("wavy-13dB-averaged", "wavy-13dB-single-look", "steep30-13dB-averaged", "rough-13dB-averaged"),
        "phantoms by name, where no folder of scans is given",
    )
    shape: tuple[int, int, int] = setting(
        (64, 256, 160), "voxels of every phantom (bscan, axial, lateral)", unit="voxels", low=4, high=4096
    )
    presets: tuple[str, ...] = setting(("fast", "sparse"), "presets of the fits")
    alphas: tuple[float, ...] = setting(
        (0.0, 0.2), "shares of interpolated samples, for presets that draw them", low=0.0, high=1.0
    )
    steps: int = setting(0, "gradient steps of a fit, 0 for the preset's", low=0, high=10_000_000)
    seed: int = setting(100, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = SlicesBenchConfig(phantoms=("wavy-13dB-averaged", "wavy-13dB-single-look"), shape=(32, 160, 96), steps=300)
