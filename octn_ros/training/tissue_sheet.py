"""The sheet that tissue follows: how deep its surface lies in each A-scan, so that B-scans are averaged along it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator
from scipy.ndimage import gaussian_filter1d, median_filter

from octn_ros.volume import Volume

_SLAB_VOXELS = 1 << 22  # worked on at a time, so that whoever cancels waits for some hundredths of a second
# Gaussians, in voxels, before the rise along the beam is looked for: across the beam and along it.
_LATERAL_SIGMA, _AXIAL_SIGMA = 2.0, 2.0
# What a voxel of depth from one A-scan to the next costs, as a share of a typical rise.
_PRICE_PER_VOXEL = 0.1
_MEDIAN_ASCANS = 9  # keeps steps sharp
# Share of an error of prediction that is expected at half the distance. At least: what is smooth loses more, but a
# share of nothing would let a network trust the sheet blindly. At most: that of a random walk, the roughest that goes
# on from B-scan to B-scan; where neighbours are too far apart to tell, what is measured would be the whole of it.
_LEAST_SHARE, _MOST_SHARE = 1.0 / 16.0, 0.5
# In standard deviations, the median's: errors beyond this are leaps, which are as large at any distance.
_LEAP = 3.0
_MOST_CELLS = 8.0  # from one B-scan to the next
_MOST_VERTICES = 1 << 26  # of the finest level when cells are added; its features take half a gigabyte


@dataclass(frozen=True, eq=False)
class TissueSheet:
    """Depth of one surface in every A-scan, which layers of tissue follow more or less; immutable, thread-safe.

    It need not be the surface of the tissue: whatever rises along the beam and goes on from A-scan to A-scan serves,
    since only differences of depth between neighbours are used. Where there is no such thing it is wrong, and who
    averages along it must find out whether that helps (`NeighbourTrainer` does).

    Attributes:
        depth: axial index [bscan, lateral], with fractions.
    """

    depth: NDArray[np.float64]

    @classmethod
    def of(cls, volume: Volume, cancelled: Callable[[], bool]) -> TissueSheet:
        """Find the sheet of a volume, B-scan by B-scan: the steepest rise along the beam, on a path of least cost.

        Args:
            volume: the C-scan.
            cancelled: asked every few B-scans; after True the others keep a depth of 0.
        """
        bscans, axials, laterals = volume.geometry.shape
        depth = np.zeros((bscans, laterals))
        step = max(1, _SLAB_VOXELS // (axials * laterals))
        for first in range(0, bscans, step):
            if cancelled():
                break
            slab = slice(first, first + step)
            depth[slab] = _steepest_path(volume.normalized(slab))
        return cls(median_filter(depth, size=(1, _MEDIAN_ASCANS), mode="nearest"))

    def at(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depth [position, lateral] between B-scans, by Akima's spline, which does not overshoot at steps.

        Args:
            positions: counted in B-scans from 0; beyond the ends the sheet is held.
        """
        held = np.clip(positions, 0.0, len(self.depth) - 1.0)
        return np.asarray(Akima1DInterpolator(np.arange(len(self.depth)), self.depth)(held))

    @cached_property
    def movement(self) -> float:
        """Voxels that it moves along the beam from one B-scan to the next; nine of ten A-scans move less."""
        return float(np.quantile(np.abs(np.diff(self.depth, axis=0)), 0.9))

    @cached_property
    def share_at_half_distance(self) -> float:
        """What is left, at half the distance between B-scans, of an error of `at`.

        From how second differences grow when the distance doubles: fourfold on smooth tissue, by the square root of
        two on a random walk. The interpolation is better by one order than a straight line, so the square of that
        ratio is taken.
        """
        depth = self.depth
        if len(depth) < 5:
            return _MOST_SHARE
        near = np.square(depth[:-2] - 2.0 * depth[1:-1] + depth[2:]).mean()
        far = np.square(depth[:-4] - 2.0 * depth[2:-2] + depth[4:]).mean()
        return float(np.clip(near / far, _LEAST_SHARE, _MOST_SHARE)) if far > 0.0 else _MOST_SHARE

    def as_if_between(self, bscan: int, neighbours: Sequence[int]) -> NDArray[np.float64]:
        """Return the depth [lateral] in a B-scan with the error that it has between B-scans at their own distance.

        Interpolated between neighbours two apart, as when the B-scan had not been measured, it would be farther off
        than it ever is where the field is asked. So its error is taken times `share_at_half_distance`, but that of a
        leap, which is of the tissue and not of the distance, is taken whole.

        Args:
            bscan: its number.
            neighbours: the numbers, rising by two, of B-scans around it.
        """
        measured = self.depth[bscan]
        guessed = TissueSheet(self.depth[list(neighbours)]).at(np.array([(bscan - neighbours[0]) / 2.0]))[0]
        error = guessed - measured
        leap = np.abs(error) > _LEAP * 1.4826 * np.median(np.abs(error))
        return np.asarray(measured + np.where(leap, 1.0, self.share_at_half_distance) * error)

    def cells_per_bscan(self, least: float, axials: int) -> float:
        """Return how many cells from B-scan to B-scan follow it: about a voxel of movement in each.

        Args:
            least: how many there are in any case.
            axials: voxels of an A-scan; large scans get fewer cells, so that memory lasts.
        """
        affordable = _MOST_VERTICES // (self.depth.size * axials)
        return max(least, min(_MOST_CELLS, float(affordable), math.ceil(self.movement - 0.5)))


def _steepest_path(planes: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the axial index [bscan, lateral] of the rise that B-scans [bscan, axial, lateral] follow across."""
    smooth = gaussian_filter1d(planes, _LATERAL_SIGMA, axis=2, mode="nearest")
    rise = np.maximum(gaussian_filter1d(smooth, _AXIAL_SIGMA, axis=1, order=1, mode="nearest"), 0.0)
    typical = np.median(rise.max(axis=1), axis=1)[:, None, None]
    cost = np.ascontiguousarray(np.moveaxis(-rise / np.maximum(typical, 1e-6), 2, 0))  # [lateral, bscan, axial]
    depth = _cheapest_path(cost)
    # Between voxels: the vertex of the parabola through the rises around it.
    inner = depth.clip(1, planes.shape[1] - 2)
    before, here, after = (np.take_along_axis(cost, (inner + o)[..., None], axis=2)[..., 0] for o in (-1, 0, 1))
    bend = before - 2.0 * here + after
    offset = np.where(bend > 1e-6, 0.5 * (before - after) / np.maximum(bend, 1e-6), 0.0)
    return np.asarray((inner + offset.clip(-1.0, 1.0)).T, np.float64)


def _cheapest_path(cost: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return for each A-scan [lateral, bscan] which depth a path of least cost [lateral, bscan, axial] takes.

    Dynamic programming; `_PRICE_PER_VOXEL` for every voxel of difference between neighbours.
    """
    row = np.arange(cost.shape[2], dtype=np.float32)
    ramp = np.float32(_PRICE_PER_VOXEL) * row
    totals = np.empty_like(cost)
    totals[0] = cost[0]
    for lateral in range(1, len(cost)):
        # The least of total + price * distance, from above and from below.
        falling = np.minimum.accumulate(totals[lateral - 1] - ramp, axis=1) + ramp
        rising = np.minimum.accumulate((totals[lateral - 1] + ramp)[:, ::-1], axis=1)[:, ::-1] - ramp
        np.add(np.minimum(falling, rising), cost[lateral], out=totals[lateral])
    depth = np.empty(cost.shape[:2], np.int64)
    depth[-1] = totals[-1].argmin(axis=1)
    for lateral in range(len(cost) - 2, -1, -1):
        way = np.float32(_PRICE_PER_VOXEL) * np.abs(row - depth[lateral + 1][:, None])
        depth[lateral] = (totals[lateral] + way).argmin(axis=1)
    return depth
