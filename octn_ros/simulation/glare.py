"""Glare: specular spots that saturate the detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.simulation.optics import Light
from octn_ros.simulation.patch import random_places, spread_places
from octn_ros.simulation.surface import TissueSurface

SPOT_RADIUS_M = 30e-6  # at which the reflection has fallen to exp(-1/2): a wet facet seen through the beam's spot
SPOT_APART_M = 0.5e-3
PEAK_OVER_WHITE_DB = 15.0  # far beyond the detector: the display is clipped
LOBE_DB = -25.0  # side lobes of the source's spectrum at the surface, against the peak
LOBE_DECAY_M = 120e-6
LOBE_PERIOD_M = 45e-6
STREAK_OVER_AIR_DB = 18.0  # a saturated spectrum spreads over every depth: a bright column from top to bottom
MASKED_POWER = 4.0  # where the reflection still outshines air by 6 dB, the surface looks brighter than it is
_CANDIDATES = 400


@dataclass(frozen=True, eq=False)
class Glare:
    """Specular spots where the surface stands square to the beam; immutable and thread-safe.

    Attributes:
        places_m: (x, y) of each spot in the tissue's frame [N, 2].
        peak_power: of a spot's reflection over air, linear.
    """

    places_m: NDArray[np.float64]
    peak_power: float

    @classmethod
    def placed(
        cls,
        count: int,
        surface: TissueSurface,
        half_sides_m: tuple[float, float],
        white_over_air_db: float,
        seed: int,
    ) -> Glare:
        """Return `count` spots at the places of least slope among many random ones, apart from each other."""
        places = random_places(np.random.default_rng([seed, 3]), _CANDIDATES, surface.centre_m, half_sides_m)
        slope = np.hypot(*surface.slope_at(places[:, 0], places[:, 1]))
        # Rounded, so that a plane's equal slopes keep the random order.
        order = np.argsort(np.round(slope, 9), kind="stable")
        peak = 10.0 ** ((white_over_air_db + PEAK_OVER_WHITE_DB) / 10.0)
        return cls(spread_places(places[order], count, SPOT_APART_M), peak)

    def mask(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where a streak drowns the surface, or the reflection outshines it."""
        return np.asarray(self._weight(x_m, y_m) * self.peak_power > MASKED_POWER)

    def apply(self, light: Light) -> None:
        """Add the spots to the light that comes back."""
        weight = self._weight(light.x, light.y)
        bscan, lateral = np.nonzero(weight * self.peak_power > 1e-3)
        below = light.below[bscan, :, lateral]
        peak = np.exp(-0.5 * (below / light.sigma_m) ** 2)
        lobes = 10.0 ** (LOBE_DB / 10.0) * np.exp(-np.abs(below) / LOBE_DECAY_M)
        lobes *= np.cos(np.pi * below / LOBE_PERIOD_M) ** 2
        streak = 10.0 ** (STREAK_OVER_AIR_DB / 10.0)
        spot = self.peak_power * (peak + lobes) + streak
        light.power[bscan, :, lateral] += (weight[bscan, lateral, None] * spot).astype(np.float32)

    def _weight(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        weight = np.zeros(x.shape)
        for place in self.places_m:
            squared = (x - place[0]) ** 2 + (y - place[1]) ** 2
            np.maximum(weight, np.exp(-0.5 * squared / SPOT_RADIUS_M**2), out=weight)
        return weight
