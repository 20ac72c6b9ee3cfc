"""The true air-tissue interface of a phantom, known in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Directions in the lateral plane, degrees from the lateral axis towards the bscan axis. None lies along an axis or a
# diagonal, so that a swapped or mirrored axis never looks like the original.
TILT_DIRECTION_DEG = 25.0
# (share of the amplitude, share of the period, direction) of each wave; the shares of the amplitude sum to one.
_WAVES = ((0.6, 1.0, 15.0), (0.4, 0.7, 110.0))


@dataclass(frozen=True)
class Wave:
    """One sinusoid of the interface.

    Attributes:
        amplitude_m: half its height, metres.
        wave_vector: phase per metre along (lateral, bscan), radians per metre.
    """

    amplitude_m: float
    wave_vector: tuple[float, float]


@dataclass(frozen=True)
class TissueSurface:
    """Interface z = s(x, y) in the OCT frame: a plane plus sinusoids; immutable and thread-safe, NumPy only.

    Attributes:
        depth_m: z at `centre_m`, metres.
        centre_m: (x, y) about which plane and waves turn, metres.
        slope: dz/dx and dz/dy of the plane.
        waves: the sinusoids added to the plane, each zero at `centre_m`.
    """

    depth_m: float
    centre_m: tuple[float, float]
    slope: tuple[float, float] = (0.0, 0.0)
    waves: tuple[Wave, ...] = ()

    @classmethod
    def flat(cls, depth_m: float, centre_m: tuple[float, float]) -> TissueSurface:
        """Return the plane z = `depth_m`."""
        return cls(depth_m, centre_m)

    @classmethod
    def tilted(cls, depth_m: float, centre_m: tuple[float, float], tilt_deg: float) -> TissueSurface:
        """Return a plane through (`centre_m`, `depth_m`) whose normal leans `tilt_deg` degrees off the beam."""
        steepness, direction = math.tan(math.radians(tilt_deg)), math.radians(TILT_DIRECTION_DEG)
        return cls(depth_m, centre_m, (steepness * math.cos(direction), steepness * math.sin(direction)))

    @classmethod
    def wavy(
        cls, depth_m: float, centre_m: tuple[float, float], tilt_deg: float, amplitude_m: float, period_m: float
    ) -> TissueSurface:
        """Return the tilted plane with waves that stay within `amplitude_m` of it, the longest of `period_m`."""
        plane = cls.tilted(depth_m, centre_m, tilt_deg)
        waves = []
        for amplitude_share, period_share, direction_deg in _WAVES:
            number, direction = 2.0 * math.pi / (period_share * period_m), math.radians(direction_deg)
            vector = (number * math.cos(direction), number * math.sin(direction))
            waves.append(Wave(amplitude_share * amplitude_m, vector))
        return cls(depth_m, centre_m, plane.slope, tuple(waves))

    def depth_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the depth z in metres at lateral `x_m` and bscan `y_m`, metres, broadcast together."""
        x, y = self._centred(x_m, y_m)
        depth = self.depth_m + self.slope[0] * x + self.slope[1] * y
        for wave in self.waves:
            depth = depth + wave.amplitude_m * np.sin(wave.wave_vector[0] * x + wave.wave_vector[1] * y)
        return np.asarray(depth)

    def normal_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the unit normals [..., 3] that point into the tissue (z > 0), in the OCT frame."""
        x, y = self._centred(x_m, y_m)
        slope_x = np.full(x.shape, self.slope[0])
        slope_y = np.full(x.shape, self.slope[1])
        for wave in self.waves:
            steepness = wave.amplitude_m * np.cos(wave.wave_vector[0] * x + wave.wave_vector[1] * y)
            slope_x += steepness * wave.wave_vector[0]
            slope_y += steepness * wave.wave_vector[1]
        normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return normal

    def _centred(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        return x - self.centre_m[0], y - self.centre_m[1]
