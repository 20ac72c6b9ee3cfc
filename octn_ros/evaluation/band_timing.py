"""How long a band query takes: with the index, exhaustively, and by thresholding the raw voxels."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.field import Field
from octn_ros.query import PAPER_BANDS, BandIndex, BandQuery, Box, Lattice, find_band, find_band_exhaustively
from octn_ros.volume import Volume, VolumeGeometry


@dataclass(frozen=True)
class BandTiming:
    """Seconds of one band in one region, medians of runs that took turns.

    Attributes:
        low: lowest intensity.
        high: highest intensity.
        share: share of the field's samples in the region that lie in the band.
        indexed_s: `find_band` with every block known.
        exhaustive_s: `find_band_exhaustively` on the same field.
        numpy_s: NumPy on the raw voxels: threshold and list the points.
    """

    low: float
    high: float
    share: float
    indexed_s: float
    exhaustive_s: float
    numpy_s: float

    @property
    def ratio_lattice(self) -> float:
        """Exhaustive time over indexed time."""
        return self.exhaustive_s / self.indexed_s

    @property
    def ratio_numpy(self) -> float:
        """NumPy's time over indexed time."""
        return self.numpy_s / self.indexed_s


@dataclass(frozen=True)
class BandTimings:
    """The bands of the paper's table 2 in one region.

    Attributes:
        bands: one by one.
        voxels: voxels of the region.
        fill_s: what asking the field at the voxels of the region took, once.
        index_bytes: memory of the index after that.
    """

    bands: tuple[BandTiming, ...]
    voxels: int
    fill_s: float
    index_bytes: int

    @property
    def ratio_lattice(self) -> float:
        """The least of the bands' `ratio_lattice`."""
        return min(band.ratio_lattice for band in self.bands)

    @property
    def ratio_numpy(self) -> float:
        """The least of the bands' `ratio_numpy`."""
        return min(band.ratio_numpy for band in self.bands)


def time_bands(field: Field, volume: Volume, side_m: float = 3e-3, repeats: int = 3) -> BandTimings:
    """Time the bands of the paper's table 2 in the middle of a scan.

    Compiling is not counted: everything is run once before.

    Args:
        field: a field of which no voxel was asked for yet; its index stays.
        volume: the voxels that it was made of.
        side_m: lateral sides of the region, which has the depth of the scan; cut off at the scan's border.
        repeats: runs of each, of which the median counts.
    """
    region = middle_of(volume.geometry, side_m)
    queries = [
        BandQuery(band.low, band.high, half_open=band.half_open, max_points=1_000_000_000) for band in PAPER_BANDS
    ]
    find_band_exhaustively(field, queries[-1], middle_of(volume.geometry, 1e-4))
    began = time.perf_counter()
    find_band(field, queries[-1], region)
    fill_s = time.perf_counter() - began
    lattice = Lattice.over(volume.geometry, region, name="band timing")
    bands = []
    for query in queries:
        ways: tuple[Callable[[], object], ...] = (
            lambda query=query: find_band(field, query, region),  # type: ignore[misc]
            lambda query=query: find_band_exhaustively(field, query, region),  # type: ignore[misc]
            lambda query=query: threshold_voxels(volume, query, lattice),  # type: ignore[misc]
        )
        times = np.array([[_seconds(way) for way in ways] for _ in range(repeats)])
        share = len(find_band(field, query, region).points_m) / lattice.size
        bands.append(BandTiming(query.low, query.high, share, *(float(np.median(column)) for column in times.T)))
    return BandTimings(tuple(bands), lattice.size, fill_s, BandIndex.of(field).nbytes)


def threshold_voxels(
    volume: Volume, query: BandQuery, lattice: Lattice
) -> tuple[NDArray[np.float64], NDArray[np.generic]]:
    """Return points (x, y, z) [N, 3] in metres and raw values [N] of the voxels of a band, by NumPy alone.

    The limits are taken to raw values, so that the voxels are compared as they were measured.

    Args:
        volume: the measured C-scan.
        query: the band.
        lattice: the voxels that are looked at.
    """
    low, high = volume.intensity_range
    axes = lattice.bscan, lattice.axial, lattice.lateral
    part = volume.array[tuple(slice(round(axis[0]), round(axis[-1]) + 1) for axis in axes)]
    first, last = (low + limit * (high - low) for limit in (query.low, query.high))
    chosen = (part >= first) & ((part < last) if query.half_open else (part <= last))
    bscan, axial, lateral = np.nonzero(chosen)
    x, y, z = lattice.axes_m()
    return np.column_stack([x[lateral], y[bscan], z[axial]]), part[chosen]


def middle_of(geometry: VolumeGeometry, side_m: float) -> Box:
    """Return the square column in the middle of a scan, of all depths."""
    centre = np.array(geometry.origin_m[:2]) + np.array(geometry.extent_m[:2]) / 2.0
    (x0, y0), (x1, y1) = (centre - side_m / 2.0).tolist(), (centre + side_m / 2.0).tolist()
    return Box((x0, y0, -np.inf), (x1, y1, np.inf))


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
