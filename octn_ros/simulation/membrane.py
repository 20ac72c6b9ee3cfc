"""A detached bright layer: a fragment of membrane or drape in the air above the tissue."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from octn_ros.simulation.optics import Light
from octn_ros.simulation.patch import Patch

RADII_M = (0.7e-3, 0.45e-3)
RIM_M = 20e-6  # a torn edge, blurred by the beam's spot
GAP_M = (200e-6, 320e-6)  # air between it and the tissue, from one end to the other
THICKNESS_M = 40e-6
BRIGHTNESS_DB = 5.0  # over the tissue's backscatter
TRANSMISSION_DB = -3.0  # both ways
MASKED_SHARE = 0.01


@dataclass(frozen=True)
class Membrane:
    """A thin bright fragment that hangs over part of the tissue; immutable and thread-safe.

    Attributes:
        patch: its outline.
    """

    patch: Patch

    @classmethod
    def placed(cls, centre_m: tuple[float, float], half_sides_m: tuple[float, float], seed: int) -> Membrane:
        """Return a fragment at a random angle near the middle of the scan, no larger than half of it."""
        generator = np.random.default_rng([seed, 5])
        place = np.asarray(centre_m) + generator.uniform(-0.3, 0.3, 2) * half_sides_m
        scale = min(1.0, 0.5 * min(half_sides_m) / RADII_M[0])
        radii = (RADII_M[0] * scale, RADII_M[1] * scale)
        angle = generator.uniform(0.0, math.pi)
        return cls(Patch((float(place[0]), float(place[1])), radii, float(angle), RIM_M))

    def mask(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where the fragment hangs over the tissue."""
        return np.asarray(self.patch.share(x_m, y_m) > MASKED_SHARE)

    def apply(self, light: Light) -> None:
        """Dim what lies below the fragment, and add it."""
        share = self.patch.share(light.x, light.y)
        bscan, lateral = np.nonzero(share)
        along, _ = self.patch.local(light.x[bscan, lateral], light.y[bscan, lateral])
        gap = np.interp(along, (-self.patch.radii_m[0], self.patch.radii_m[0]), GAP_M)[:, None]
        share = share[bscan, lateral, None]
        inside = light.below[bscan, :, lateral] + gap + THICKNESS_M  # depth below its upper face
        power = light.power[bscan, :, lateral]
        power *= 1.0 - (1.0 - 10.0 ** (TRANSMISSION_DB / 10.0)) * share
        body = ndtr(inside / light.sigma_m) - ndtr((inside - THICKNESS_M) / light.sigma_m)
        power += share * light.tissue_power * 10.0 ** (BRIGHTNESS_DB / 10.0) * body
        light.power[bscan, :, lateral] = power
