"""A patch of tissue seen from the probe: an ellipse with a soft rim, and how random ones are placed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Random places keep within this share of the scan's half sides, so that artefacts lie inside a raster.
PLACED_SHARE = 0.75


@dataclass(frozen=True)
class Patch:
    """An ellipse in the lateral plane; immutable and thread-safe.

    Attributes:
        centre_m: (x, y) of its centre, metres.
        radii_m: half its axes, metres.
        angle_rad: angle of the first axis from lateral towards bscan.
        rim_m: width over which it fades, metres.
    """

    centre_m: tuple[float, float]
    radii_m: tuple[float, float]
    angle_rad: float
    rim_m: float

    def local(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return places along the ellipse's own axes, metres from its centre."""
        x, y = np.asarray(x_m) - self.centre_m[0], np.asarray(y_m) - self.centre_m[1]
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return cos * x + sin * y, cos * y - sin * x

    def share(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return how much of the patch is at broadcast `x_m` and `y_m`: 1 inside, 0 outside, linear over the rim."""
        along, across = self.local(x_m, y_m)
        radius = np.hypot(along / self.radii_m[0], across / self.radii_m[1])
        return np.asarray(np.clip(0.5 + (1.0 - radius) * min(self.radii_m) / self.rim_m, 0.0, 1.0))


def random_places(
    generator: np.random.Generator, count: int, centre_m: tuple[float, float], half_sides_m: tuple[float, float]
) -> NDArray[np.float64]:
    """Draw `count` places (x, y) [count, 2] well inside a scan of these half sides, metres."""
    unit = generator.uniform(-PLACED_SHARE, PLACED_SHARE, (count, 2))
    return np.asarray(unit * np.asarray(half_sides_m) + np.asarray(centre_m))


def spread_places(candidates: NDArray[np.float64], count: int, apart_m: float) -> NDArray[np.float64]:
    """Return the first `count` of the candidates [N, 2] that lie `apart_m` from each other, closer ones if need be."""
    chosen: list[NDArray[np.float64]] = []
    left = list(candidates)
    while left and len(chosen) < count:
        fit = next((k for k, place in enumerate(left) if _clear(place, chosen, apart_m)), None)
        if fit is None:
            apart_m *= 0.7
            continue
        chosen.append(left.pop(fit))
    return np.array(chosen).reshape(-1, 2)


def _clear(place: NDArray[np.float64], chosen: list[NDArray[np.float64]], apart_m: float) -> bool:
    return all(math.dist(place, other) >= apart_m for other in chosen)
