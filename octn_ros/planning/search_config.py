"""How the surface under a raster is looked for."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as dataclass_field

from octn_ros.planning.coarse_surface import CoarseSurfaceConfig
from octn_ros.planning.trust import TrustConfig
from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class SurfaceSearchConfig:
    """How the surface under a raster is found."""

    coarse: CoarseSurfaceConfig = dataclass_field(default_factory=CoarseSurfaceConfig)
    trust: TrustConfig = dataclass_field(default_factory=TrustConfig)
    refinement: str = setting(
        "newton",
        "newton: onto the level set; least_squares: smoothly along it (eq. 14); sgd: the same by gradient descent",
        choices=("newton", "least_squares", "sgd"),
    )
    tau_mode: str = setting(
        "global", "one tau for the raster, or local: half-way from air to tissue around each waypoint",
        choices=("global", "local"),
    )  # fmt: skip
    aperture_m: float = setting(
        0.0, "radius of the disc over which the field is averaged around each waypoint, 0 for the field itself",
        unit="m", low=0.0, high=1e-3,
    )  # fmt: skip
    offset_correction_m: float = setting(
        0.0, "added to every depth: minus the offset of the level set from the true surface, once calibrated",
        unit="m", low=-1e-3, high=1e-3,
    )  # fmt: skip
    warmup_candidates: int = setting(7, "candidate depths around the coarse surface, N_warmup", low=2, high=1024)
    neighbourhood_m: float = setting(
        88e-6, "how far from the coarse surface a waypoint may lie, N_voxels as a length", unit="m", low=1e-6, high=5e-3
    )
    newton_steps: int = setting(8, "largest number of Newton steps before bisection", low=1, high=1000)
    min_gradient: float = setting(
        1e-3, "axial gradient below which a Newton step is skipped", unit="1/voxel", low=1e-9, high=1.0
    )
    max_step_m: float = setting(29e-6, "longest Newton step", unit="m", low=1e-9, high=5e-3)
    convergence: float = setting(0.01, "|f - tau| / tau at which a waypoint is done", low=1e-6, high=0.5)
    tolerance: float = setting(0.05, "|f - tau| / tau above which a root is given up", low=1e-6, high=0.5)
    smoothness_per_m2: float = setting(
        3.3e8, "lambda of eq. 14, for depths in metres", unit="1/m^2", low=0.0, high=1e18
    )
    leeway_m: float = setting(22e-6, "how far the smooth path may leave the level set", unit="m", low=0.0, high=5e-3)
    smoothing_steps: int = setting(20, "largest number of least-squares steps", low=1, high=1000)
    descent_steps: int = setting(1000, "number of gradient descent steps", low=1, high=1_000_000)
    descent_rate: float = setting(
        0.05, "gradient descent: step per unit of gradient, depths in voxels", low=1e-9, high=1e3
    )
    break_m: float = setting(
        44e-6, "second difference of depth from which on the surface is taken to break, as at a step", unit="m",
        low=1e-6, high=5e-3,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def method(self) -> str:
        """The search in words, to be named with every result."""
        refinement = {
            "newton": "bracketed Newton with exact gradients and bisection",
            "least_squares": "sparse least squares of eq. 14 from Newton's roots, "
            f"lambda {self.smoothness_per_m2:g} / m^2",
            "sgd": f"{self.descent_steps} steps of gradient descent on eq. 14, lambda {self.smoothness_per_m2:g} / m^2",
        }[self.refinement]
        aperture = f", the field averaged within {self.aperture_m * 1e6:.0f} um" if self.aperture_m > 0 else ""
        local = ", tau half-way between air and tissue around each waypoint" if self.tau_mode == "local" else ""
        correction = self.offset_correction_m * 1e6
        offset = f", depth corrected by {correction:+.1f} um" if correction else ""
        return f"{refinement}{aperture}{local}{offset}; {self.coarse.method}"
