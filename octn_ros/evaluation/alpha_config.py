"""What `octn bench alpha` is run on."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as dataclass_field

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.settings import check_settings, setting
from octn_ros.training import FitConfig

# A field that learns the speckle: four cells per voxel along the longest axis, and hashed tables, which points between
# the B-scans share with others. What has neither has nothing between its B-scans that interpolated samples could cure.
LEARNS_SPECKLE = NeuralFieldConfig(
    HashGridConfig(levels=8, features=2, log2_table_size=13, base_resolution=8, finest_ratio=4.0),
    NetworkConfig(hidden_layers=2, neurons=32),
)


@dataclass(frozen=True)
class AlphaBenchConfig:
    """Everything that decides the table."""

    phantoms: tuple[str, ...] = setting(
        ("wavy-15dB-averaged", "rough-13dB-averaged", "steep30-13dB-averaged"),
        "phantoms by name, where no folder of scans is given",
    )
    shape: tuple[int, int, int] = setting(
        (16, 48, 48),
        "voxels of every phantom (bscan, axial, lateral), and of the block around the surface that is cut out of "
        "every measured scan",
        unit="voxels",
        low=8,
        high=4096,
    )
    alphas: tuple[float, ...] = setting(
        (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), "shares of interpolated samples in the hybrid stage", low=0.0, high=1.0
    )
    fit: FitConfig = dataclass_field(
        default_factory=lambda: FitConfig(preset="alpha", field=LEARNS_SPECKLE, steps=300, batch=1 << 12)
    )
    seed: int = setting(0, "seed of tissue, speckle and fits", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


QUICK = AlphaBenchConfig(
    phantoms=("wavy-15dB-averaged",),
    shape=(16, 32, 32),
    fit=FitConfig(
        preset="alpha",
        field=NeuralFieldConfig(
            HashGridConfig(levels=8, features=2, log2_table_size=12, base_resolution=8, finest_ratio=4.0),
            NetworkConfig(hidden_layers=2, neurons=32),
        ),
        steps=200,
        batch=1 << 11,
    ),
)
