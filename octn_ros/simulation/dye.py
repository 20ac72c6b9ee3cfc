"""Dye: patches of tissue-marking ink on the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.simulation.optics import Light
from octn_ros.simulation.patch import Patch, random_places, spread_places

RADII_M = (0.35e-3, 0.22e-3)
RIM_M = 60e-6
APART_M = 0.8e-3
THICKNESS_M = 60e-6
FADE_M = 20e-6  # over which the ink thins out into the tissue
GAINS_DB = (7.0, -6.0)  # pigments that scatter and pigments that absorb, in turn
ATTENUATION_PER_M = 15e3  # in the ink, passed twice: 8 dB through the whole of it
MASKED_SHARE = 0.02


@dataclass(frozen=True)
class Dye:
    """Ink that changes how bright the surface is and dims what lies below; immutable and thread-safe.

    Attributes:
        patch: where the ink is.
        gain_db: backscatter of the ink over the tissue's.
    """

    patch: Patch
    gain_db: float

    @classmethod
    def placed(
        cls, count: int, centre_m: tuple[float, float], half_sides_m: tuple[float, float], seed: int
    ) -> tuple[Dye, ...]:
        """Return `count` patches apart from each other, bright and dark ones in turn."""
        generator = np.random.default_rng([seed, 6])
        places = spread_places(random_places(generator, 100, centre_m, half_sides_m), count, APART_M)
        angles = generator.uniform(0.0, math.pi, len(places))
        return tuple(
            cls(Patch((float(x), float(y)), RADII_M, float(angle), RIM_M), GAINS_DB[k % len(GAINS_DB)])
            for k, ((x, y), angle) in enumerate(zip(places, angles, strict=True))
        )

    def mask(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where ink makes the surface brighter or darker than tissue."""
        return np.asarray(self.patch.share(x_m, y_m) > MASKED_SHARE)

    def apply(self, light: Light) -> None:
        """Change the backscatter of the inked layer, and dim it and what lies below."""
        share = self.patch.share(light.x, light.y)
        bscan, lateral = np.nonzero(share)
        below, share = light.below[bscan, :, lateral], share[bscan, lateral, None]
        gain_db = share * np.interp(below, (THICKNESS_M, THICKNESS_M + FADE_M), (self.gain_db, 0.0))
        passed = 2.0 * ATTENUATION_PER_M * share * np.clip(below, 0.0, THICKNESS_M)
        light.power[bscan, :, lateral] *= (10.0 ** (gain_db / 10.0) * np.exp(-passed)).astype(np.float32)
