"""Which B-scan of a C-scan an image is, and how far B-scans lie apart, from the poses of their image frames."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError

IMAGE2OCT_ROTATION: NDArray[np.float64] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Axes of the B-scan image frame in the OCT frame: x = lateral, y = axial (image down), z = -bscan."""
IMAGE2OCT_ROTATION.flags.writeable = False

# How far a B-scan may lie from its place, as a share of the spacing: wide of what float32 poses lose, and far below
# the half spacing at which the index would be ambiguous.
PLACE_TOLERANCE = 0.1
_ROTATION_TOLERANCE = 1e-3
_STEP_DECIMALS = 12  # a picometre: what a mean of float64 poses states, without its rounding


class BScanPlaces:
    """Follows the B-scans of one C-scan after another along the slow axis; not thread-safe.

    The OCT frame's origin is the centre of the first voxel of B-scan 0, so B-scan 0 is the one at y = 0. The step to
    the next one is stated, or the mean over the B-scans taken so far: B-scan 1 is then where the second one lies, and
    where it was dropped the third one does not lie twice as far.

    Args:
        count: number of B-scans in a C-scan.
        spacing_m: metres between voxel centres along (bscan, axial, lateral); bscan None: the poses tell.
    """

    def __init__(self, count: int, spacing_m: tuple[float | None, float, float]) -> None:
        self._count = count
        self._stated_m, self._axial_m, self._lateral_m = spacing_m
        self._start_tolerance_m = PLACE_TOLERANCE * (self._stated_m or min(self._axial_m, self._lateral_m))
        self._first_m = (0.0, 0.0, 0.0)
        self._last_y_m = 0.0
        self._taken = 0

    @property
    def origin_m(self) -> tuple[float, float, float]:
        """Where B-scan 0 of the present C-scan begins, as (x, y, z)."""
        return self._first_m

    @property
    def step_m(self) -> float | None:
        """Metres from one B-scan to the next; None while nothing tells."""
        if self._stated_m is not None:
            return self._stated_m
        if self._taken < 2:
            return None
        return round((self._last_y_m - self._first_m[1]) / (self._taken - 1), _STEP_DECIMALS)

    def why_missing(self, index: int) -> str:
        """Return what else than a loss may be the reason that B-scan `index` came after the ones taken so far."""
        if self._stated_m is None or self._taken != 1:
            return ""
        return (
            f", or B-scans lie {index * self._stated_m * 1e6:g} um apart and not the {self._stated_m * 1e6:g} um that "
            "are stated (spacing_um)"
        )

    def forget(self) -> None:
        """Begin anew: no B-scan of the present C-scan has been taken."""
        self._taken = 0

    def begins(self, pose: NDArray[np.float64]) -> bool:
        """Return whether a B-scan lies where B-scan 0 does."""
        return abs(float(pose[1, 3])) <= self._start_tolerance_m

    def take(self, pose: NDArray[np.float64]) -> None:
        """Take a B-scan whose index is the next one."""
        if not self._taken:
            self._first_m = (float(pose[0, 3]), float(pose[1, 3]), float(pose[2, 3]))
        self._last_y_m = float(pose[1, 3])
        self._taken += 1

    def index(self, pose: NDArray[np.float64]) -> int:
        """Return the index of a B-scan with this pose [4, 4].

        Raises:
            VolumeError: it is turned or lies between two places, outside the C-scan, or sideways of B-scan 0.
        """
        y = float(pose[1, 3])
        index = 0 if self.begins(pose) else self._index_at(y)
        if np.abs(pose[:3, :3] - IMAGE2OCT_ROTATION).max() > _ROTATION_TOLERANCE:
            raise VolumeError(
                f"B-scan {index}: expected image axes x, y, z along lateral, axial and -bscan of the OCT frame, got "
                f"{np.round(pose[:3, :3], 4).tolist()}; mirror a scan direction in the scanner's configuration instead"
            )
        if not 0 <= index < self._count:
            raise VolumeError(
                f"expected B-scan indices 0 to {self._count - 1}, got {index} (y = {y * 1e6:g} um); of a scanner that "
                f"sends more than the {self._count} that are stated (bscan_count) a part was taken for the whole"
            )
        if index and self._taken:
            self._check_beside_first(index, pose)
        return index

    def _index_at(self, y: float) -> int:
        step = self.step_m
        if step is None:
            if self._taken and y > 0.0:
                return 1
            raise VolumeError(
                f"expected {'B-scan 1 beyond' if self._taken else 'B-scan 0, which begins a C-scan, at'} y = 0, got "
                f"one at y = {y * 1e6:g} um; waiting for a B-scan 0"
            )
        place = (y - (self._first_m[1] if self._taken else 0.0)) / step
        index = math.floor(place + 0.5)
        if abs(place - index) > PLACE_TOLERANCE:
            raise VolumeError(
                f"expected B-scans every {step * 1e6:g} um from y = 0, got one at y = {y * 1e6:g} um, between the "
                f"indices {math.floor(place)} and {math.floor(place) + 1}{self._why(y - self._last_y_m)}"
            )
        return index

    def _why(self, gap: float) -> str:
        """Return what a step below the one between the first two B-scans says of those that are missing there."""
        if self._stated_m is not None or self._taken != 2 or gap <= 0.0:
            return ""
        steps = (self._last_y_m - self._first_m[1]) / gap
        dropped = round(steps) - 1
        if dropped < 1 or abs(steps - round(steps)) > PLACE_TOLERANCE * steps:
            return ""
        return f"; missing: 1{f' to {dropped}' if dropped > 1 else ''}, if B-scans lie {gap * 1e6:g} um apart"

    def _check_beside_first(self, index: int, pose: NDArray[np.float64]) -> None:
        across, along = float(pose[0, 3]) - self._first_m[0], float(pose[2, 3]) - self._first_m[2]
        if abs(across) > PLACE_TOLERANCE * self._lateral_m or abs(along) > PLACE_TOLERANCE * self._axial_m:
            raise VolumeError(
                f"B-scan {index}: expected it where B-scan 0 begins, got it shifted by {across * 1e6:.2f} um "
                f"laterally and {along * 1e6:.2f} um axially"
            )
