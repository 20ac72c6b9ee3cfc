"""What `octn bench raster` is run on: phantoms, raster, fields, methods."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.settings import check_settings, setting
from octn_ros.simulation import NAMED_PHANTOMS

# The system that the tables are made on: the paper's 13 dB, fully developed speckle, every voxel its own draw.
SYSTEM = "-13dB-single-look"
_TISSUES = tuple(f"{tissue}{SYSTEM}" for tissue in NAMED_PHANTOMS)
_OTHER_SYSTEMS = (
    "wavy-13dB-averaged",
    "wavy-18dB-single-look",
    "wavy-8dB-single-look",
    "wavy-13dB-single-look-grain1.2",
    "wavy-13dB-single-look-top-layer",
)
# Every field and method, plain gradient descent and a fit for each filter among them, takes its time.
_IN_FULL = tuple(f"{tissue}{SYSTEM}" for tissue in ("wavy", "stepped", "glare"))


@dataclass(frozen=True)
class RasterBenchConfig:
    """Everything that decides the table besides the planner's own defaults."""

    phantoms: tuple[str, ...] = setting(
        (*_TISSUES, *_OTHER_SYSTEMS), "phantoms by name, with newton and least_squares on interpolated-gaussian"
    )
    phantoms_fitted: tuple[str, ...] = setting(_TISSUES, "those of them that have neural-raw as well")
    phantoms_in_full: tuple[str, ...] = setting(_IN_FULL, "those of them that have every field and method")
    bscans: int = setting(0, "B-scans of every phantom, 0 as named", low=0, high=4096)
    laterals: int = setting(0, "A-scans per B-scan of every phantom, 0 as named", low=0, high=4096)
    side_m: float = setting(3e-3, "side of the square raster", unit="m", low=1e-4, high=0.1)
    spacing_m: float = setting(50e-6, "distance of lines and of waypoints along them", unit="m", low=1e-6, high=1e-2)
    fit_s: float = setting(10.0, "time budget of a neural fit, preset fast", unit="s", low=0.1, high=3600.0)
    descent_steps: int = setting(1000, "steps of gradient descent, the paper's number", low=1, high=100_000)
    timing_shape: tuple[int, int, int] = setting(
        (256, 512, 512), "volume that times are measured on, the paper's", unit="voxels", low=8, high=4096
    )
    timing_side_m: float = setting(4.95e-3, "side of the raster that times are measured on", unit="m", low=1e-4)
    # Not 0 or another of the small numbers that settings were chosen on.
    seed: int = setting(100, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = RasterBenchConfig(
    phantoms=(f"wavy{SYSTEM}", f"glare{SYSTEM}"),
    phantoms_fitted=(f"wavy{SYSTEM}", f"glare{SYSTEM}"),
    phantoms_in_full=(),
    bscans=48,
    laterals=96,
    side_m=1.2e-3,
    fit_s=3.0,
    descent_steps=100,
    timing_shape=(64, 160, 192),
    timing_side_m=1.6e-3,
)
