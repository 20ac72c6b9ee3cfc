"""How a field is fitted: Algorithm 1's parameters, and the two presets."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as dataclass_field

from octn_ros.errors import ConfigurationError
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.field.backend import BACKENDS
from octn_ros.settings import check_settings, setting

OBJECTIVES = ("voxels", "neighbours")


@dataclass(frozen=True)
class FitConfig:
    """Parameters of Algorithm 1. What the paper leaves open says so."""

    preset: str = setting("paper", "name of the preset these settings started from")
    field: NeuralFieldConfig = dataclass_field(default_factory=NeuralFieldConfig)
    steps: int = setting(1000, "gradient steps T", low=1, high=10_000_000)
    time_budget_s: float = setting(
        0.0, "end the fit after this many seconds, 0 for never; both stages shrink with it", unit="s", low=0.0, high=1e6
    )
    target_psnr_db: float = setting(
        0.0,
        "end the fit at this PSNR on fixed voxels of evenly spaced B-scans, 0 for never",
        unit="dB",
        low=0.0,
        high=120.0,
    )
    stop_at_noise: bool = setting(
        False, "end the fit once its error is down to the noise, which is estimated from neighbouring B-scans"
    )
    batch: int = setting(1 << 18, "samples per step B (open in the paper)", low=64, high=1 << 24)
    alpha: float = setting(0.20, "share of interpolated samples in the hybrid stage", low=0.0, high=1.0)
    hybrid_share: float = setting(
        0.5, "share of the fit spent in the hybrid stage, r_hyb (open in the paper)", low=0.0, high=1.0
    )
    learning_rate: float = setting(1e-2, "Adam's learning rate at the start (open in the paper)", low=1e-6, high=1.0)
    final_rate_ratio: float = setting(
        0.05,
        "learning rate at the end over that at the start, falling exponentially (open in the paper)",
        low=1e-6,
        high=1.0,
    )
    start_from_data: bool = setting(
        False, "begin with block averages of the volume instead of random features (open in the paper)"
    )
    objective: str = setting(
        "voxels",
        "what is learned: voxels, as in the paper; or neighbours: tables hold the volume at several scales, and the "
        "network learns to predict B-scans from those beside them, whose speckle is another (open in the paper)",
        choices=OBJECTIVES,
    )
    bricks: bool = setting(
        False,
        "whether samples may come in bricks of 8 x 8 x 8 neighbours, which the CPU's compiled kernels need, instead of "
        "alone (open in the paper)",
    )
    backend: str = setting(
        "auto",
        "what takes the steps. auto: the fastest there is, compiled kernels on the CPU if bricks are allowed, triton "
        "on CUDA; torch: the plain reference, any device; compiled: with bricks in any case; triton; tiny-cuda-nn",
        choices=BACKENDS,
    )
    seed: int = setting(0, "seed of the initial parameters and of all samples", low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.objective == "neighbours" and not self.start_from_data:
            raise ConfigurationError("objective neighbours: expected start_from_data, on which it rests; switch it on")
        if round(self.alpha * self.batch, 6) < 1 and self.alpha > 0:
            raise ConfigurationError(f"alpha {self.alpha} of a batch of {self.batch} is no sample at all; raise either")


# Two CPU cores: few levels, all dense, whose cells follow the voxels' shape but are twice as fine along the beam, a
# small network, compiled bricks of samples, a start from the data, and a time budget. Everything else is Algorithm 1.
FAST = FitConfig(
    preset="fast",
    field=NeuralFieldConfig(
        HashGridConfig(
            levels=3,
            features=2,
            log2_table_size=26,
            base_resolution=16,
            finest_ratio=0.35,
            follow_shape=True,
            axial_refinement=2.0,
        ),
        NetworkConfig(hidden_layers=1, neurons=32),
    ),
    steps=3000,
    time_budget_s=10.0,
    batch=1 << 15,
    learning_rate=3e-4,
    start_from_data=True,
    bricks=True,
)
# For scans with few B-scans, or with much speckle: every level keeps voxels along the beam and B-scans apart, these by
# more cells where tissue moves from one to the next; cells double across the beam from level to level; and only the
# network is learned, from what B-scans share with their neighbours.
SPARSE = FitConfig(
    preset="sparse",
    field=NeuralFieldConfig(
        HashGridConfig(
            levels=3,
            features=2,
            log2_table_size=28,
            finest_ratio=1.0,
            follow_shape=True,
            lateral_growth=2.0,
            cells_per_bscan=1.0,
        ),
        NetworkConfig(hidden_layers=1, neurons=32),
    ),
    steps=1500,
    time_budget_s=20.0,
    batch=1 << 13,
    alpha=0.0,
    hybrid_share=0.0,
    learning_rate=3e-3,
    start_from_data=True,
    objective="neighbours",
)
PRESETS = {"paper": FitConfig(), "fast": FAST, "sparse": SPARSE}
