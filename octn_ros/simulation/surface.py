"""The true air-tissue interface of a phantom, known in closed form."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.simulation.interface import Interface

# Directions in the lateral plane, degrees from the lateral axis towards the bscan axis. None lies along an axis or a
# diagonal, so that a swapped or mirrored axis never looks like the original.
TILT_DIRECTION_DEG = 25.0
# (share of the amplitude, share of the period, direction) of each wave; the shares of the amplitude sum to one.
_WAVES = ((0.6, 1.0, 15.0), (0.4, 0.7, 110.0))
# (share of the height, distance of the edge from the centre, direction) of each step.
_STEPS = ((1.0, -0.6e-3, 25.0), (-0.6, 0.5e-3, 110.0))
# Roughness: its spectrum ends where that of a Gaussian correlation has fallen to exp(-3), and so many sinusoids make
# the depths all but normally distributed.
_ROUGH_WAVES = 64
_ROUGH_BAND = 2.45  # standard deviations
_STEP_RISE = 2.0 * math.atanh(0.8)  # scales of a tanh between 10 % and 90 % of its height


@dataclass(frozen=True)
class Wave:
    """One sinusoid of the interface, `amplitude_m * sin(wave_vector . (x, y) + phase_rad)`.

    Attributes:
        amplitude_m: half its height, metres.
        wave_vector: phase per metre along (lateral, bscan), radians per metre.
        phase_rad: phase at the centre.
    """

    amplitude_m: float
    wave_vector: tuple[float, float]
    phase_rad: float = 0.0


@dataclass(frozen=True)
class Step:
    """One straight, smooth step, `height_m / 2 * (1 + tanh((direction . (x, y) - place_m) / scale_m))`.

    Attributes:
        height_m: how much deeper the far side lies, metres.
        direction: unit vector across the edge, along (lateral, bscan).
        place_m: where its middle crosses a line through the centre along the direction, metres.
        scale_m: a 10 % to 90 % rise is 2.2 scales wide.
    """

    height_m: float
    direction: tuple[float, float]
    place_m: float
    scale_m: float


@dataclass(frozen=True)
class TissueSurface(Interface):
    """Interface z = s(x, y) in the OCT frame: a plane plus sinusoids and steps; immutable, thread-safe, NumPy only.

    Attributes:
        depth_m: z at `centre_m`, metres, before phases and steps.
        centre_m: (x, y) about which plane, waves and steps turn, metres.
        slope: dz/dx and dz/dy of the plane.
        waves: the sinusoids added to the plane.
        steps: the steps added to the plane.
    """

    depth_m: float
    centre_m: tuple[float, float]
    slope: tuple[float, float] = (0.0, 0.0)
    waves: tuple[Wave, ...] = ()
    steps: tuple[Step, ...] = ()

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

    @classmethod
    def steep(
        cls, depth_m: float, centre_m: tuple[float, float], steepest_deg: float, period_m: float
    ) -> TissueSurface:
        """Return folds of `period_m` whose flanks reach `steepest_deg`: one wave of a = period tan(angle) / (2 pi)."""
        number, direction = 2.0 * math.pi / period_m, math.radians(TILT_DIRECTION_DEG)
        vector = (number * math.cos(direction), number * math.sin(direction))
        return cls(depth_m, centre_m, waves=(Wave(math.tan(math.radians(steepest_deg)) / number, vector),))

    @classmethod
    def rough(
        cls,
        depth_m: float,
        centre_m: tuple[float, float],
        tilt_deg: float,
        rms_m: float,
        correlation_m: float,
        seed: int,
    ) -> TissueSurface:
        """Return the tilted plane with band-limited random roughness: 64 sinusoids of equal amplitude.

        Their wave vectors are normally distributed with sigma = sqrt(2) / correlation along each axis, cut off at 2.45
        sigma, and their phases are uniform, so that the correlation over a distance r is near
        exp(-(r / correlation)^2). The root mean square over a large area is `rms_m` exactly.

        Args:
            depth_m: z of the plane at the centre.
            centre_m: (x, y) of the centre.
            tilt_deg: lean of the plane off the beam, degrees.
            rms_m: root mean square height of the roughness.
            correlation_m: distance at which its correlation has fallen to 1/e.
            seed: seed of wave vectors and phases.
        """
        generator = np.random.default_rng([seed, 1])
        # Radii from the Rayleigh distribution up to the band's end, by its inverse; even shares instead of draws, so
        # that every seed has the whole band.
        shares = (np.arange(_ROUGH_WAVES) + generator.uniform(size=_ROUGH_WAVES)) / _ROUGH_WAVES
        shares *= 1.0 - math.exp(-0.5 * _ROUGH_BAND**2)
        numbers = np.sqrt(-2.0 * np.log1p(-shares)) * math.sqrt(2.0) / correlation_m
        directions = generator.uniform(0.0, 2.0 * math.pi, _ROUGH_WAVES)
        phases = generator.uniform(0.0, 2.0 * math.pi, _ROUGH_WAVES)
        amplitude = rms_m * math.sqrt(2.0 / _ROUGH_WAVES)
        waves = tuple(
            Wave(amplitude, (float(k * math.cos(a)), float(k * math.sin(a))), float(p))
            for k, a, p in zip(numbers, directions, phases, strict=True)
        )
        return cls(depth_m, centre_m, cls.tilted(depth_m, centre_m, tilt_deg).slope, waves)

    @classmethod
    def stepped(
        cls, depth_m: float, centre_m: tuple[float, float], tilt_deg: float, height_m: float, rise_m: float
    ) -> TissueSurface:
        """Return the tilted plane with a step of `height_m` down and one of 60 % of it up, each `rise_m` wide.

        Args:
            depth_m: z of the plane at the centre, before the steps.
            centre_m: (x, y) of the centre.
            tilt_deg: lean of the plane off the beam, degrees.
            height_m: height of the first step.
            rise_m: lateral distance from 10 % to 90 % of a step's height.
        """
        steps = []
        for share, place, direction_deg in _STEPS:
            direction = math.radians(direction_deg)
            across = (math.cos(direction), math.sin(direction))
            steps.append(Step(share * height_m, across, place, rise_m / _STEP_RISE))
        return cls(depth_m, centre_m, cls.tilted(depth_m, centre_m, tilt_deg).slope, steps=tuple(steps))

    def moved(self, rotation_deg: float, shift_m: tuple[float, float, float]) -> TissueSurface:
        """Return the same interface turned about the beam through `centre_m`, then shifted by (x, y, z) metres."""
        if not rotation_deg and not any(shift_m):
            return self
        cos, sin = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))

        def turned(vector: tuple[float, float]) -> tuple[float, float]:
            return cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]

        return TissueSurface(
            self.depth_m + shift_m[2],
            (self.centre_m[0] + shift_m[0], self.centre_m[1] + shift_m[1]),
            turned(self.slope),
            tuple(dataclasses.replace(wave, wave_vector=turned(wave.wave_vector)) for wave in self.waves),
            tuple(dataclasses.replace(step, direction=turned(step.direction)) for step in self.steps),
        )

    def depth_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the depth z in metres at lateral `x_m` and bscan `y_m`, metres, broadcast together."""
        x, y = self._centred(x_m, y_m)
        depth = self.depth_m + self.slope[0] * x + self.slope[1] * y
        for wave in self.waves:
            depth = depth + wave.amplitude_m * np.sin(
                wave.wave_vector[0] * x + wave.wave_vector[1] * y + wave.phase_rad
            )
        for step in self.steps:
            depth = depth + 0.5 * step.height_m * (1.0 + np.tanh(_across(step, x, y)))
        return np.asarray(depth)

    def slope_at(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return dz/dx and dz/dy, without unit, at broadcast `x_m` and `y_m`."""
        x, y = self._centred(x_m, y_m)
        slope_x, slope_y = np.full(x.shape, self.slope[0]), np.full(x.shape, self.slope[1])
        for wave in self.waves:
            rise = wave.amplitude_m * np.cos(wave.wave_vector[0] * x + wave.wave_vector[1] * y + wave.phase_rad)
            slope_x += rise * wave.wave_vector[0]
            slope_y += rise * wave.wave_vector[1]
        for step in self.steps:
            rise = 0.5 * step.height_m / step.scale_m * (1.0 - np.tanh(_across(step, x, y)) ** 2)
            slope_x += rise * step.direction[0]
            slope_y += rise * step.direction[1]
        return slope_x, slope_y

    def curvature_at(
        self, x_m: ArrayLike, y_m: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the second derivatives d2z/dx2, d2z/dxdy and d2z/dy2 in 1/m at broadcast `x_m` and `y_m`."""
        x, y = self._centred(x_m, y_m)
        xx, xy, yy = np.zeros(x.shape), np.zeros(x.shape), np.zeros(x.shape)
        bends = [(-w.amplitude_m * np.sin(w.wave_vector[0] * x + w.wave_vector[1] * y + w.phase_rad), w.wave_vector)
                 for w in self.waves]  # fmt: skip
        for step in self.steps:
            tanh = np.tanh(_across(step, x, y))
            bends.append((-step.height_m / step.scale_m**2 * tanh * (1.0 - tanh**2), step.direction))
        for bend, (along_x, along_y) in bends:
            xx += bend * along_x * along_x
            xy += bend * along_x * along_y
            yy += bend * along_y * along_y
        return xx, xy, yy

    def _centred(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        return x - self.centre_m[0], y - self.centre_m[1]


def _across(step: Step, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return (step.direction[0] * x + step.direction[1] * y - step.place_m) / step.scale_m
