"""Shadows: hairs above the tissue that let hardly any light through."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from octn_ros.simulation.optics import Light

RADIUS_M = 40e-6
GAP_M = 100e-6  # air between the hair and the tissue
TRANSMISSION_DB = -25.0  # both ways, below the middle of the hair
BRIGHTNESS_DB = 8.0  # backscatter of the hair over the tissue's
ATTENUATION_PER_M = 15e3  # in the hair, passed twice: pigment takes the light within its diameter
BEAM_SIGMA_M = 8.5e-6  # the beam's spot, 20 um full width at half maximum, blurs the shadow's edge
MASKED_SHARE = 0.05


@dataclass(frozen=True)
class Hair:
    """A hair that lies along a straight line over the tissue and follows its relief; immutable and thread-safe.

    Attributes:
        normal: unit vector across it, along (lateral, bscan).
        place_m: distance of its axis from the origin along that vector, metres.
    """

    normal: tuple[float, float]
    place_m: float

    @classmethod
    def placed(
        cls, count: int, centre_m: tuple[float, float], half_sides_m: tuple[float, float], seed: int
    ) -> tuple[Hair, ...]:
        """Return `count` hairs in random directions, each through the inner half of the scan."""
        generator = np.random.default_rng([seed, 4])
        hairs = []
        for _ in range(count):
            angle, offset = generator.uniform(0.0, math.pi), generator.uniform(-0.5, 0.5) * min(half_sides_m)
            normal = (math.cos(angle), math.sin(angle))
            hairs.append(cls(normal, normal[0] * centre_m[0] + normal[1] * centre_m[1] + offset))
        return tuple(hairs)

    def mask(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where the hair or its shadow hides the surface."""
        return np.asarray(self._cover(self._across(x_m, y_m)) > MASKED_SHARE)

    def apply(self, light: Light) -> None:
        """Darken what lies below the hair, and add the hair."""
        across = self._across(light.x, light.y)
        cover = self._cover(across)
        bscan, lateral = np.nonzero(cover > 1e-4)
        share, across = cover[bscan, lateral, None], across[bscan, lateral, None]
        below, power = light.below[bscan, :, lateral], light.power[bscan, :, lateral]
        power *= 1.0 - (1.0 - 10.0 ** (TRANSMISSION_DB / 10.0)) * share
        half = np.sqrt(np.clip(RADIUS_M**2 - across**2, 0.0, None))  # half the chord that the beam passes
        inside = below + GAP_M + RADIUS_M + half  # depth below the hair's upper edge
        body = ndtr(inside / light.sigma_m) - ndtr((inside - 2.0 * half) / light.sigma_m)
        body *= np.exp(-2.0 * ATTENUATION_PER_M * np.clip(inside, 0.0, 2.0 * half))
        power += share * light.tissue_power * 10.0 ** (BRIGHTNESS_DB / 10.0) * body
        light.power[bscan, :, lateral] = power

    def _across(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(self.normal[0] * np.asarray(x_m) + self.normal[1] * np.asarray(y_m) - self.place_m)

    def _cover(self, across: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of the beam that meets the hair."""
        return np.asarray(ndtr((RADIUS_M - across) / BEAM_SIGMA_M) - ndtr((-RADIUS_M - across) / BEAM_SIGMA_M))
