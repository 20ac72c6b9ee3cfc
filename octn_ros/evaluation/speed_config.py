"""What `octn bench speed` is run on: phantoms, fits, and how long each of them may take."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.settings import check_settings, setting
from octn_ros.training import PRESETS, FitConfig

# In the order of the tables: plain torch, the same compiled by torch, and the kernels of this package.
WAYS = ("eager", "compile", "fused")
# Of order of the field that the paper's method was tried with on CPUs before: more and finer levels, two hidden layers.
MANY_LEVELS = NeuralFieldConfig(
    HashGridConfig(levels=8, features=2, log2_table_size=19, base_resolution=16, finest_ratio=0.5),
    NetworkConfig(hidden_layers=2, neurons=32),
)
# What plain torch reaches the truth soonest with, from the mean: dense levels of four features, 4 bits per voxel.
PLAIN = NeuralFieldConfig(HashGridConfig(features=4), NetworkConfig(hidden_layers=1, neurons=32), bits_per_voxel=4.0)


@dataclass(frozen=True)
class SpeedBenchConfig:
    """Everything that decides the figures besides the preset `fast`."""

    shape: tuple[int, int, int] = setting(
        (128, 160, 256), "phantom of the time to the quality of a Gaussian", unit="voxels", low=16, high=4096
    )
    full_shape: tuple[int, int, int] = setting(
        (256, 512, 512), "phantom of the 30 dB, of rates and of queries", unit="voxels", low=16, high=4096
    )
    samples_shape: tuple[int, int, int] = setting(
        (64, 80, 128), "phantom that bricks are compared with lone samples on", unit="voxels", low=16, high=4096
    )
    target_db: float = setting(30.0, "PSNR against the measured voxels to be reached", unit="dB", low=1.0, high=60.0)
    mean_rate: float = setting(
        1e-2, "Adam's learning rate where a fit starts from the mean; from the data it is the preset's", low=1e-6
    )
    budgets_s: tuple[float, ...] = setting(
        (6.0, 20.0, 60.0),
        "time budgets of a fit that is to reach the quality, one after the other until one does; the learning rate "
        "falls over each",
        unit="s",
        low=0.1,
    )
    full_budget_s: float = setting(15.0, "time budget of each curve on the full phantom", unit="s", low=0.1)
    rate_s: float = setting(4.0, "time over which steps are counted", unit="s", low=0.05)
    samples: int = setting(1 << 22, "samples of each fit with bricks or lone samples", low=1 << 15)
    divisors: tuple[int, ...] = setting(
        (4, 2, 1), "the full phantom's sides are divided by each for the cost against size, 1 last", low=1, high=64
    )
    ways: tuple[str, ...] = setting(("eager", "compile", "fused"), "what takes the steps; fused last", choices=WAYS)
    full_ways: tuple[str, ...] = setting(
        ("eager", "compile", "fused"), "those that have a curve from the mean on the full phantom", choices=WAYS
    )
    thorough: bool = setting(True, "rates on both phantoms, and of a field of many levels as well")
    batch: int = setting(1 << 15, "samples of a step", low=64)
    hybrid_share: float = setting(0.5, "share of a fit that draws interpolated samples too", low=0.0, high=1.0)
    compile_modes: tuple[str, ...] = setting(
        ("default", "max-autotune-no-cudagraphs"), "modes of torch.compile that are tried for the rate"
    )
    region_side_m: float = setting(3e-3, "side of the region of a band query", unit="m", low=1e-5, high=0.1)
    raster_side_m: float = setting(4.95e-3, "side of the raster of 50 um", unit="m", low=1e-4, high=0.1)
    raster_fit_s: float = setting(5.0, "time budget of the fit that the raster is planned on", unit="s", low=0.1)
    repeats: int = setting(3, "runs of a query of which the median counts", low=1, high=100)
    # Not 0 or another of the small numbers that settings were chosen on.
    seed: int = setting(100, "seed of speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def sizes(self) -> tuple[tuple[int, int, int], ...]:
        """The shapes of the cost against size, by default 1/64, 1/8 and 1 of the full phantom's voxels."""
        bscans, axials, laterals = self.full_shape
        return tuple((bscans // n, axials // n, laterals // n) for n in self.divisors)

    def fit_config(self, start: str) -> FitConfig:
        """Return how a fit goes that starts from "data", which is the preset `fast`, or from the "mean".

        From the mean it is the preset but for its field and its learning rate.
        """
        preset = dataclasses.replace(PRESETS["fast"], batch=self.batch, hybrid_share=self.hybrid_share, seed=self.seed)
        if start == "data":
            return preset
        return dataclasses.replace(preset, field=PLAIN, start_from_data=False, learning_rate=self.mean_rate)


QUICK = SpeedBenchConfig(
    shape=(32, 80, 64),
    full_shape=(64, 160, 128),
    samples_shape=(16, 40, 32),
    budgets_s=(3.0,),
    divisors=(2, 1),
    full_budget_s=1.5,
    rate_s=0.5,
    samples=1 << 18,
    full_ways=("eager", "fused"),
    thorough=False,
    hybrid_share=1.0,
    compile_modes=("default",),
    region_side_m=1e-3,
    raster_side_m=1.5e-3,
    raster_fit_s=1.0,
)
