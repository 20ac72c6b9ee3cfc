"""What `octn bench compare` is run on."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.evaluation.rival_fields import RIVALS
from octn_ros.settings import check_settings, setting
from octn_ros.training import PRESETS

BUDGETS = ("seconds", "samples")


@dataclass(frozen=True)
class CompareBenchConfig:
    """Everything that decides the table besides the presets and the published settings of the others."""

    phantoms: tuple[str, ...] = setting(
        ("wavy-13dB-averaged", "wavy-13dB-single-look", "rough-13dB-averaged"),
        "phantoms by name, where no folder of scans is given",
    )
    shape: tuple[int, int, int] = setting(
        (97, 256, 160), "voxels of every phantom (bscan, axial, lateral)", unit="voxels", low=8, high=4096
    )
    factor: int = setting(2, "every so many-th B-scan is fitted, the others are held out", low=2, high=64)
    presets: tuple[str, ...] = setting(("fast", "sparse", "paper"), "fits of this package", choices=tuple(PRESETS))
    rivals: tuple[str, ...] = setting(("cunerf", "siren"), "other neural fields", choices=tuple(RIVALS))
    budgets: tuple[str, ...] = setting(BUDGETS, "what is the same for all neural fields", choices=BUDGETS)
    seconds: float = setting(60.0, "duration of each fit where seconds are the same", unit="s", low=0.1, high=1e6)
    samples: int = setting(1 << 20, "samples of each fit where samples are the same", low=1 << 10, high=1 << 40)
    paper_batch: int = setting(
        1 << 14, "samples per step of the preset paper, whose own 262,144 leave a CPU hardly a step", low=64
    )
    judged_bscans: int = setting(16, "evenly spaced B-scans of either kind that figures are of", low=1, high=4096)
    # Not 0 or another of the small numbers that settings were chosen on.
    seed: int = setting(100, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = CompareBenchConfig(
    phantoms=("wavy-13dB-averaged",),
    shape=(33, 96, 64),
    seconds=1.5,
    samples=1 << 15,
    paper_batch=1 << 11,
    judged_bscans=8,
)
