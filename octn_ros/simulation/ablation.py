"""Tissue under the laser: what has been taken away of a phantom, and what a scan of it shows then."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from octn_ros.simulation.crater import AblatedSurface
from octn_ros.simulation.laser import LaserConfig
from octn_ros.simulation.phantom import Phantom, make_phantom
from octn_ros.simulation.phantom_config import PhantomConfig


class PhantomTissue:
    """A phantom that a laser cuts; not thread-safe.

    What is gone is kept as a map of depths at the A-scans of the first scan, in the tissue's own frame, which is the
    OCT frame as long as the tissue has not moved. So there are no overhangs, and what lies beyond the scan is not kept.

    Args:
        config: the whole phantom.

    Attributes:
        config: the same.
        removed_m: depth taken away along z at each A-scan [bscan, lateral], metres.
    """

    def __init__(self, config: PhantomConfig) -> None:
        self.config = config
        bscans, _, laterals = config.shape
        self._spacing_m = config.spacing_m[0], config.spacing_m[2]
        self._x = np.arange(laterals) * self._spacing_m[1]
        self._y = np.arange(bscans) * self._spacing_m[0]
        self._whole = config.true_surface()
        self._depth_m = self._whole.depth_at(self._x, self._y[:, None])
        self.removed_m = np.zeros((bscans, laterals))
        self._made: tuple[Phantom, tuple[float, ...], int] | None = None
        self._shots = self._scans = 0

    @property
    def removed_volume_m3(self) -> float:
        """Volume taken away, cubic metres."""
        return float(self.removed_m.sum() * self._spacing_m[0] * self._spacing_m[1])

    def fire(self, focus2tissue: NDArray[np.float64], dwell_s: float, laser: LaserConfig) -> float:
        """Take away what one shot does.

        The crater lies along the beam: each point of the surface moves along it by the crater's depth at its distance
        from the axis. On the map that is the depth times (b n) / n_z, b the beam and n the normal of the surface as it
        is: exact for a vertical beam, and to first order in the depth over the spot for a tilted one. A part of the
        tissue that looks away from the beam is left alone.

        Args:
            focus2tissue: pose of the focus, z along the beam, in the tissue's frame [4, 4].
            dwell_s: length of the shot.
            laser: what it was fired with.

        Returns:
            The volume taken away, cubic metres; 0 for a beam that comes from below.
        """
        focus, beam = focus2tissue[:3, 3], focus2tissue[:3, 2]
        if beam[2] <= 0.0:
            return 0.0
        defocus = abs(float(self._depth_there(focus[0], focus[1]) - focus[2]))
        # Where a tilted beam is out of focus, it meets the surface beside the place below the focus.
        reach = (laser.reach_m(defocus) + defocus * float(np.hypot(beam[0], beam[1]))) / float(beam[2])
        rows = slice(*np.searchsorted(self._y, (focus[1] - reach, focus[1] + reach)))
        columns = slice(*np.searchsorted(self._x, (focus[0] - reach, focus[0] + reach)))
        removed = self.removed_m[rows, columns]
        if not removed.size:
            return 0.0
        z = self._depth_m[rows, columns] + removed - focus[2]
        x, y = self._x[columns] - focus[0], self._y[rows, None] - focus[1]
        along = x * beam[0] + y * beam[1] + z * beam[2]
        crater = laser.crater_m(np.maximum(x**2 + y**2 + z**2 - along**2, 0.0), dwell_s, defocus)
        slope_y, slope_x = self._slopes(rows, columns)
        crater *= np.maximum(beam[2] - slope_x * beam[0] - slope_y * beam[1], 0.0)
        removed += crater
        self._shots += 1
        return float(crater.sum() * self._spacing_m[0] * self._spacing_m[1])

    def scan(self, place_m: NDArray[np.float64]) -> Phantom:
        """Return the phantom as a scan shows it, `place_m` [3] away from where it lay at first, metres.

        Unchanged tissue is the same scan again, noise and all; changed tissue has speckle of its own.

        Raises:
            ConfigurationError: the tissue has moved out of the scan.
        """
        place, before = (float(place_m[0]), float(place_m[1]), float(place_m[2])), self._made
        if before is None or before[1] != place or before[2] != self._shots:
            (x, y, z), (by_x, by_y, by_z) = self.config.shift_m, place
            shift = x + by_x, y + by_y, z + by_z
            config = dataclasses.replace(self.config, shift_m=shift, seed=self.config.seed + self._scans)
            crater = None if not self._shots else self._seen_from(place)
            self._made = make_phantom(config, crater), place, self._shots
            self._scans += 1
        assert self._made is not None
        return self._made[0]

    def _seen_from(self, place_m: tuple[float, ...]) -> NDArray[np.float64]:
        if not (place_m[0] or place_m[1]):
            return self.removed_m.copy()
        ablated = AblatedSurface(self._whole, self.removed_m, self._spacing_m)
        return ablated.removed_at(self._x - place_m[0], self._y[:, None] - place_m[1])

    def _depth_there(self, x_m: float, y_m: float) -> float:
        row = int(np.clip(round(y_m / self._spacing_m[0]), 0, len(self._y) - 1))
        column = int(np.clip(round(x_m / self._spacing_m[1]), 0, len(self._x) - 1))
        return float(self._depth_m[row, column] + self.removed_m[row, column])

    def _slopes(self, rows: slice, columns: slice) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return dz/dy and dz/dx of the present surface on a part of the map, which may be a single A-scan."""
        wide_rows = slice(max(rows.start - 1, 0), rows.stop + 1)
        wide_columns = slice(max(columns.start - 1, 0), columns.stop + 1)
        surface = self._depth_m[wide_rows, wide_columns] + self.removed_m[wide_rows, wide_columns]
        inner = (
            slice(rows.start - wide_rows.start, rows.stop - wide_rows.start),
            slice(columns.start - wide_columns.start, columns.stop - wide_columns.start),
        )
        by_y = np.gradient(surface, self._spacing_m[0], axis=0)
        by_x = np.gradient(surface, self._spacing_m[1], axis=1)
        return by_y[inner], by_x[inner]
