"""The coaxial laser: what it emits, and the crater that one shot of it leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.settings import check_settings, setting

# The share of a crater's depth at which it is taken to end.
_NOTHING = 1e-5


@dataclass(frozen=True)
class LaserConfig:
    """A pulsed laser and how the tissue answers to it; a shot is a burst of pulses while the focus passes a waypoint.

    The crater of a shot is that of the RATS platform, z = -A exp(-((dx^2 + dy^2) / (2 sigma^2))^P) along the beam,
    where A is such that its volume is the energy of the shot beyond the threshold over the heat of ablation: the
    steady-state model, in which each cubic metre takes the same energy away. The heat of ablation of soft tissue is
    some 3 to 4 kJ per cubic centimetre (Vogel and Venugopalan 2003, Chem. Rev. 103). Charring, drying and the heat
    that builds up between shots are not modelled.
    """

    power_w: float = setting(2.0, "power of a pulse", unit="W", low=0.0, high=1000.0)
    duty_cycle: float = setting(0.2, "share of a burst in which the laser emits", low=0.0, high=1.0)
    dwell_s: float = setting(
        5e-3, "length of the burst at a waypoint, shorter where the next one comes sooner", unit="s", low=0.0, high=10.0
    )
    sigma_m: float = setting(
        75e-6, "sigma of the crater; its depth has fallen to 1/e at sqrt(2) sigma, the radius of the spot", unit="m",
        low=1e-6, high=0.01,
    )  # fmt: skip
    order: float = setting(1.5, "order P of the crater; 1 is a Gaussian, more has a flatter floor", low=0.5, high=20.0)
    rayleigh_range_m: float = setting(
        3.3e-3, "distance from the focus at which the spot is sqrt(2) times as wide", unit="m", low=1e-5, high=1.0
    )
    heat_of_ablation_j_per_m3: float = setting(
        3.5e9, "energy that takes a cubic metre of the tissue away", unit="J/m^3", low=1e6, high=1e15
    )
    threshold_j: float = setting(0.0, "energy of a shot that takes nothing away yet", unit="J", low=0.0, high=1000.0)

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def spot_radius_m(self) -> float:
        """Distance from the beam at which the crater in focus is 1/e as deep as in its middle."""
        return math.sqrt(2.0) * self.sigma_m

    @property
    def mean_power_w(self) -> float:
        """Power of a burst, the pauses between its pulses included."""
        return self.power_w * self.duty_cycle

    def removed_volume_m3(self, dwell_s: ArrayLike) -> NDArray[np.float64]:
        """Return the volume that shots of these lengths take away, cubic metres, any shape."""
        energy = self.mean_power_w * np.asarray(dwell_s, dtype=np.float64)
        return np.maximum(energy - self.threshold_j, 0.0) / self.heat_of_ablation_j_per_m3

    def raster_depth_m(self, dwell_s: float, line_spacing_m: float, point_spacing_m: float) -> float:
        """Return the depth that one pass of a raster takes away in its middle, metres."""
        return float(self.removed_volume_m3(dwell_s)) / (line_spacing_m * point_spacing_m)

    def dwell_for(self, depth_m: float, line_spacing_m: float, point_spacing_m: float) -> float:
        """Return the length of the bursts at which a pass of a raster takes this depth away, seconds."""
        energy = depth_m * line_spacing_m * point_spacing_m * self.heat_of_ablation_j_per_m3 + self.threshold_j
        return energy / self.mean_power_w

    def width(self, defocus_m: float) -> float:
        """Return sigma at a distance from the focus along the beam, metres (Gaussian beam)."""
        return self.sigma_m * math.hypot(1.0, defocus_m / self.rayleigh_range_m)

    def reach_m(self, defocus_m: float) -> float:
        """Return the distance from the beam beyond which the crater is taken to be nothing, metres."""
        return self.width(defocus_m) * math.sqrt(2.0 * (-math.log(_NOTHING)) ** (1.0 / self.order))

    def crater_m(self, squared_distance_m2: ArrayLike, dwell_s: float, defocus_m: float = 0.0) -> NDArray[np.float64]:
        """Return the depth along the beam of the crater of one shot, metres.

        Args:
            squared_distance_m2: dx^2 + dy^2 from the beam's axis, square metres, any shape.
            dwell_s: length of the burst.
            defocus_m: distance of the surface from the focus along the beam, either side.
        """
        double = 2.0 * self.width(defocus_m) ** 2
        # The integral of exp(-u^P) over the plane, u = r^2 / (2 sigma^2), is 2 pi sigma^2 Gamma(1 + 1/P).
        middle = float(self.removed_volume_m3(dwell_s)) / (math.pi * double * math.gamma(1.0 + 1.0 / self.order))
        return np.asarray(middle * np.exp(-((np.asarray(squared_distance_m2) / double) ** self.order)))
