"""Motion between B-scans: where the tissue lay while each B-scan was taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.simulation.interface import Interface


@dataclass(frozen=True, eq=False)
class Motion:
    """Displacement of the tissue during a scan; immutable and thread-safe.

    A B-scan takes milliseconds, a C-scan seconds: within one B-scan the tissue is taken to be at rest, and from one to
    the next it has moved with breath, pulse or the arm. Between B-scans the displacement is interpolated linearly.

    Attributes:
        axial_m: displacement along z at each B-scan [N], metres.
        lateral_m: displacement along x at each B-scan [N], metres.
        spacing_m: distance between B-scans, metres.
        jumps_m: size of the axial jump before each B-scan [N], 0 where there is none.
    """

    axial_m: NDArray[np.float64]
    lateral_m: NDArray[np.float64]
    spacing_m: float
    jumps_m: NDArray[np.float64]

    @classmethod
    def drawn(
        cls, bscans: int, spacing_m: float, axial_sigma_m: float, lateral_sigma_m: float, jump_m: float, seed: int
    ) -> Motion:
        """Draw normal jitter for each B-scan, independent of the others, and place one lasting axial jump.

        Args:
            bscans: number of B-scans.
            spacing_m: distance between them.
            axial_sigma_m: standard deviation of the axial jitter.
            lateral_sigma_m: standard deviation of the lateral jitter.
            jump_m: from a B-scan in the middle third on, the tissue lies this much deeper; 0 for no jump.
            seed: seed of the jitter and of the jump's place.
        """
        generator = np.random.default_rng([seed, 2])
        jumps = np.zeros(bscans)
        jumps[int(bscans * generator.uniform(1.0 / 3.0, 2.0 / 3.0))] = jump_m
        axial, lateral = generator.standard_normal((2, bscans))
        return cls(axial * axial_sigma_m + np.cumsum(jumps), lateral * lateral_sigma_m, spacing_m, jumps)

    @property
    def is_still(self) -> bool:
        """Whether nothing moves."""
        return not self.axial_m.any() and not self.lateral_m.any()

    def at(self, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lateral and axial displacement in metres where the scan had reached `y_m`."""
        place = np.asarray(y_m, dtype=np.float64) / self.spacing_m
        index = np.arange(len(self.axial_m))
        return np.interp(place, index, self.lateral_m), np.interp(place, index, self.axial_m)

    def rate_at(self, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the derivatives of both displacements by y, without unit."""
        place = np.asarray(y_m, dtype=np.float64) / self.spacing_m
        last = len(self.axial_m) - 1
        before = np.clip(np.floor(place).astype(np.intp), 0, last - 1)
        inside = (place >= 0.0) & (place <= last)
        lateral, axial = (np.diff(v)[before] / self.spacing_m * inside for v in (self.lateral_m, self.axial_m))
        return lateral, axial

    def across_jump(self, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where `y_m` lies between the two B-scans of a jump, both included: nothing lay in between."""
        place = np.asarray(y_m, dtype=np.float64) / self.spacing_m
        mask = np.zeros(place.shape, dtype=np.bool_)
        for after in np.flatnonzero(self.jumps_m):
            mask |= np.abs(place - (after - 0.5)) <= 0.5 + 1e-9
        return mask


@dataclass(frozen=True, eq=False)
class ScannedSurface(Interface):
    """An interface as a scan shows it that was taken while the tissue moved: s(x - dx(y), y) + dz(y).

    Attributes:
        at_rest: the interface before it moved.
        motion: where it lay during each B-scan.
    """

    at_rest: Interface
    motion: Motion

    def depth_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the depth z in metres at lateral `x_m` and bscan `y_m`, metres, broadcast together."""
        lateral, axial = self.motion.at(y_m)
        return self.at_rest.depth_at(np.asarray(x_m) - lateral, y_m) + axial

    def slope_at(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return dz/dx and dz/dy, without unit, at broadcast `x_m` and `y_m`."""
        lateral, _ = self.motion.at(y_m)
        lateral_rate, axial_rate = self.motion.rate_at(y_m)
        slope_x, slope_y = self.at_rest.slope_at(np.asarray(x_m) - lateral, y_m)
        return slope_x, slope_y - slope_x * lateral_rate + axial_rate

    def curvature_at(
        self, x_m: ArrayLike, y_m: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the second derivatives d2z/dx2, d2z/dxdy and d2z/dy2 in 1/m at broadcast `x_m` and `y_m`."""
        lateral, _ = self.motion.at(y_m)
        rate, _ = self.motion.rate_at(y_m)
        xx, xy, yy = self.at_rest.curvature_at(np.asarray(x_m) - lateral, y_m)
        return xx, xy - rate * xx, yy - 2.0 * rate * xy + rate * rate * xx
