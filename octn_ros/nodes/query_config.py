"""What the query node has to be told, and how much may be asked of it."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.field.device import DEVICE_DESCRIPTION
from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class QueryNodeConfig:
    """What the query node has to be told."""

    device: str = setting("auto", DEVICE_DESCRIPTION)
    calibration: str = setting("", "calibration file (YAML); empty = the package's config/calibration.yaml")
    tau: float = setting(0.0, "intensity of the surface, 0 to estimate it from the field", low=0.0, high=1.0)
    sample_spacing_m: float = setting(
        50e-6, "distance of the samples of query_surface when the request states none", unit="m", low=1e-7, high=0.1
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True)
class QueryLimits:
    """The largest questions that are answered; larger ones are refused before anything is allocated for them."""

    line_samples: int = setting(100_000, "largest number of samples of query_surface", low=2, high=1_000_000)
    slice_pixels: int = setting(1 << 22, "largest number of pixels of query_slice", low=1, high=1 << 26)
    band_points: int = setting(1_000_000, "largest number of points of a band", low=1, high=50_000_000)
    points: int = setting(1_000_000, "largest number of points of one query_points message", low=1, high=50_000_000)

    def __post_init__(self) -> None:
        check_settings(self)
