"""Intensity bands (eq. 6): the points of a scan whose intensity lies between two levels, in a region."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ConfigurationError, QueryError
from octn_ros.field import FieldDescription
from octn_ros.field.backend import numba_is_there
from octn_ros.query.band_index import LARGEST_INDEX, BandIndex
from octn_ros.query.lattice import Lattice, Source
from octn_ros.query.regions import Region
from octn_ros.settings import check_settings, setting
from octn_ros.volume import Volume


@dataclass(frozen=True)
class BandQuery:
    """Which intensities are asked for, and where they are looked for."""

    low: float = setting(0.6, "lowest intensity of the band", low=0.0, high=1.0)
    high: float = setting(1.0, "highest intensity of the band", low=0.0, high=1.0)
    half_open: bool = setting(False, "leave out the highest intensity itself, so that adjoining bands share no point")
    step_m: float = setting(
        0.0, "distance of the points along every axis, 0 for the voxels themselves", unit="m", low=0.0, high=0.1
    )
    max_points: int = setting(
        10_000_000, "largest number of points in an answer; more are an error", low=1, high=1_000_000_000
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.low < self.high:
            raise ConfigurationError(f"BandQuery: expected low < high, got {self.low} and {self.high}")

    def contains(self, intensity: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which intensities lie in the band (eq. 6)."""
        # Compared in double precision, a float32 intensity of 0.2 would lie below a band that begins at 0.2.
        low, high = np.float32(self.low), np.float32(self.high)
        below = intensity < high if self.half_open else intensity <= high
        return np.asarray((intensity >= low) & below)


# The three bands of the paper's table, which share no point.
PAPER_BANDS = (
    BandQuery(0.2, 0.4, half_open=True),
    BandQuery(0.4, 0.6, half_open=True),
    BandQuery(0.6, 1.0),
)


@dataclass(frozen=True, eq=False)
class BandPoints:
    """The points of one band; read-only.

    Attributes:
        points_m: (x, y, z) [N, 3] in the OCT frame, in metres, ordered by bscan, axial, lateral; N may be 0.
        intensity: intensity of each [N], 0 to 1.
        searched: number of lattice points that the answer stands for.
        query: what was asked for.
        description: where the field or the volume comes from: geometry, stamp, intensity scale and range.
    """

    points_m: NDArray[np.float64]
    intensity: NDArray[np.float32]
    searched: int
    query: BandQuery
    description: FieldDescription


def find_band(
    source: Source,
    query: BandQuery | None = None,
    region: Region | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> BandPoints:
    """Find the points whose intensity lies in a band (eq. 6), on a lattice over a region.

    At the voxels of a field the answer comes from its `BandIndex`: what a query asks of the field is kept for the next
    one, which then looks only at blocks that can match. It is that of `find_band_exhaustively`, which does the work for
    a measured volume, for points between voxels, for scans of more than 268 million voxels and where numba is missing.
    Not differentiable; thread-safe; any device.

    Args:
        source: a field of either kind, or a measured volume, which is looked at as it is, at its voxels.
        query: the band and the lattice; the defaults if left out.
        region: only points inside it count; None for the whole scan.
        progress: called with the share that is done, 0 to 1, after each slab; what it raises ends the query.

    Raises:
        QueryError: the region does not touch the scan, there are more points than `max_points`, or a volume is asked
            for points between its voxels.
    """
    query = query or BandQuery()
    lattice = Lattice.over(source.geometry, region, query.step_m or None, name="find_band")
    voxels = math.prod(source.geometry.shape)
    if isinstance(source, Volume) or not lattice.native or voxels > LARGEST_INDEX or not numba_is_there():
        return find_band_exhaustively(source, query, region, progress=progress)
    from octn_ros.query.band_kernel import BandSearch

    index, (x, y, z) = BandIndex.of(source), lattice.axes_m()
    axial, lateral = (slice(round(axis[0]), round(axis[-1]) + 1) for axis in (lattice.axial, lattice.lateral))
    limits = np.float32(query.low), np.float32(query.high), query.half_open
    searches, found = [], 0
    for planes in lattice.slabs():
        box = slice(round(lattice.bscan[planes.start]), round(lattice.bscan[planes.stop - 1]) + 1), axial, lateral
        samples, matching = index.samples(box), index.matching(box, *limits)
        inside = np.ones((1, 1, 1), np.bool_)
        if region is not None and matching.any():
            inside = region.contains(x[None, None, :], y[planes][:, None, None], z[None, :, None])
        search = BandSearch(samples, (box[0].start, axial.start, lateral.start), matching, inside, *limits)
        counts = search.count()
        found += int(counts.sum())
        _check_count(found, query, planes, lattice)
        searches.append((search, counts, planes))
        if progress:
            progress(planes.stop / lattice.shape[0])
    points_m, intensity, start = np.empty((found, 3)), np.empty(found, np.float32), 0
    for search, counts, planes in searches:
        own = slice(start, start + int(counts.sum()))
        search.list_points(counts, (x, y[planes], z), points_m[own], intensity[own])
        start = own.stop
    return BandPoints(points_m, intensity, lattice.size, query, source.description)


def find_band_exhaustively(
    source: Source,
    query: BandQuery | None = None,
    region: Region | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> BandPoints:
    """Find the same points by asking at every one of the lattice: the plain reference for `find_band`.

    Evaluated B-scan by B-scan in slabs within the box around the region, so memory beyond the answer stays at some
    200 MB. Arguments and errors are those of `find_band`.
    """
    query = query or BandQuery()
    lattice = Lattice.over(source.geometry, region, query.step_m or None, name="find_band")
    x, y, z = lattice.axes_m()
    points, intensities, found = [], [], 0
    for planes in lattice.slabs():
        values = lattice.evaluate(source, planes)
        chosen = query.contains(values)
        if region is not None:
            chosen &= region.contains(x[None, None, :], y[planes][:, None, None], z[None, :, None])
        bscan, axial, lateral = np.nonzero(chosen)
        found += len(bscan)
        _check_count(found, query, planes, lattice)
        points.append(np.column_stack([x[lateral], y[planes][bscan], z[axial]]))
        intensities.append(values[chosen])
        if progress:
            progress(planes.stop / lattice.shape[0])
    described = FieldDescription.of_volume(source, "voxels") if isinstance(source, Volume) else source.description
    return BandPoints(np.concatenate(points), np.concatenate(intensities), lattice.size, query, described)


def _check_count(found: int, query: BandQuery, planes: slice, lattice: Lattice) -> None:
    if found > query.max_points:
        raise QueryError(
            f"find_band: expected at most {query.max_points:,} points, got {found:,} after {planes.stop} of "
            f"{lattice.shape[0]} planes; take a smaller region, a narrower band or a larger step, or raise max_points"
        )
