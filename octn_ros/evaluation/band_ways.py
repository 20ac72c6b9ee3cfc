"""The ways to answer a band query that the paper compares, each with its time in stages."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.field import Field, load_field
from octn_ros.query import BandQuery, Box, Lattice, find_band
from octn_ros.query.lattice import canonical_index
from octn_ros.volume import Volume, VolumeGeometry, load_volume

Points = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Answer:
    """The points of one query and the seconds of its stages (fig. 3b).

    Attributes:
        points_m: (x, y, z) [N, 3] in the mask, in metres, ordered by bscan, axial, lateral.
        initialisation_s: loading the volume or the field from its file, onto the device where there is one.
        filtering_s: finding what lies in the band.
        masking_s: keeping what lies in the mask, and making points of it; None where filtering has done that.
        transfer_s: from the device; None where there is none.
    """

    points_m: Points
    initialisation_s: float
    filtering_s: float
    masking_s: float | None = None
    transfer_s: float | None = None

    @property
    def query_s(self) -> float:
        """All but the initialisation (fig. 3c)."""
        return self.filtering_s + (self.masking_s or 0.0) + (self.transfer_s or 0.0)

    @property
    def total_s(self) -> float:
        """From the file to the points (fig. 3b)."""
        return self.initialisation_s + self.query_s


@dataclass(frozen=True)
class Files:
    """Where the volume and the field lie.

    Attributes:
        volume: NIfTI, not compressed, as the paper's baseline has it.
        field: checkpoint.
        device: where the field is asked, and the voxels if it is no CPU.
    """

    volume: Path
    field: Path
    device: str


Way = Callable[[Files, BandQuery, Box], Answer]


def voxels_cpu(files: Files, query: BandQuery, mask: Box) -> Answer:
    """Threshold all raw voxels with NumPy, then keep those in the mask."""
    watch = _Watch()
    volume = load_volume(files.volume)
    initialisation = watch.lap()
    first, last = _raw_limits(volume, query)
    array = volume.array
    bscan, axial, lateral = np.nonzero((array >= first) & ((array < last) if query.half_open else (array <= last)))
    filtering = watch.lap()
    inside = _in_mask(volume.geometry, mask)[bscan, lateral]
    bscan, axial, lateral = bscan[inside], axial[inside], lateral[inside]
    x, y, z = Lattice.over(volume.geometry, name="band").axes_m()
    points = np.column_stack([x[lateral], y[bscan], z[axial]])
    return Answer(points, initialisation, filtering, watch.lap())


def voxels_gpu(files: Files, query: BandQuery, mask: Box) -> Answer:
    """Do the same with torch on the device, where the volume is brought before, as in the paper."""
    watch = _Watch(files.device)
    volume = load_volume(files.volume)
    raw = volume.array
    if raw.dtype == np.uint16:  # torch compares them on no GPU
        raw = raw.astype(np.int32)
    array = torch.from_numpy(np.ascontiguousarray(raw)).to(files.device)
    initialisation = watch.lap()
    first, last = _raw_limits(volume, query)
    found = torch.nonzero((array >= first) & ((array < last) if query.half_open else (array <= last)))
    return _masked(found, volume.geometry, mask, initialisation, watch)


def field_exhaustive(files: Files, query: BandQuery, mask: Box) -> Answer:
    """Ask the field at every voxel of the scan, threshold, then keep what lies in the mask: the paper's way."""
    watch = _Watch(files.device)
    field = load_field(files.field, files.device)
    initialisation = watch.lap()
    geometry = field.geometry
    lattice = Lattice.over(geometry, name="band")
    lateral, axial, bscan = (
        canonical_index(index, count, field.device)
        for index, count in zip((lattice.lateral, lattice.axial, lattice.bscan), geometry.shape[::-1], strict=True)
    )
    # As the field's own queries compare: in single precision.
    low, high = (float(np.float32(limit)) for limit in (query.low, query.high))
    pieces = []
    for planes in lattice.slabs():
        with torch.no_grad():
            values = field.lattice(lateral, axial, bscan[planes])
        found = torch.nonzero((values >= low) & ((values < high) if query.half_open else (values <= high)))
        found[:, 0] += planes.start
        pieces.append(found)
    return _masked(torch.cat(pieces), geometry, mask, initialisation, watch)


def field_index(files: Files, query: BandQuery, mask: Box) -> tuple[Answer, Answer]:
    """Ask through the field's index, twice: the first query asks the field in the mask and builds, the second repeats.

    Both count the loading of the field, which the second one does not do.
    """
    watch = _Watch(files.device)
    field = load_field(files.field, files.device)
    initialisation = watch.lap()
    first = _indexed(field, query, mask)
    first_s = watch.lap()
    again = _indexed(field, query, mask)
    return Answer(first, initialisation, first_s), Answer(again, initialisation, watch.lap())


def _indexed(field: Field, query: BandQuery, mask: Box) -> Points:
    return find_band(field, query, mask).points_m


def _masked(found: torch.Tensor, geometry: VolumeGeometry, mask: Box, initialisation: float, watch: _Watch) -> Answer:
    """Keep indices [N, 3] that lie in the mask and make points of them, where they are; bring these here."""
    filtering = watch.lap()
    inside = torch.from_numpy(_in_mask(geometry, mask)).to(found.device)
    found = found[inside[found[:, 0], found[:, 2]]]
    x, y, z = (torch.from_numpy(axis).to(found.device) for axis in Lattice.over(geometry, name="band").axes_m())
    points = torch.stack([x[found[:, 2]], y[found[:, 0]], z[found[:, 1]]], dim=1)
    masking = watch.lap()
    here = points.cpu().numpy()
    transfer = watch.lap()
    return Answer(here, initialisation, filtering, masking, transfer if found.device.type != "cpu" else None)


def _in_mask(geometry: VolumeGeometry, mask: Box) -> NDArray[np.bool_]:
    """Return which A-scans [bscan, lateral] lie in a mask that has the depth of the scan."""
    x, y, _ = Lattice.over(geometry, name="band").axes_m()
    return mask.contains(x[None, :], y[:, None], np.zeros((1, 1)))


def _raw_limits(volume: Volume, query: BandQuery) -> tuple[float, float]:
    """Return the band in raw values, so that voxels need not be normalised first."""
    low, high = volume.intensity_range
    first, last = (low + limit * (high - low) for limit in (query.low, query.high))
    return first, last


class _Watch:
    """Tells the seconds since it was asked before; waits for the device."""

    def __init__(self, device: str = "cpu") -> None:
        self._cuda = device.startswith("cuda")
        self._last = self._now()

    def lap(self) -> float:
        now = self._now()
        self._last, seconds = now, now - self._last
        return seconds

    def _now(self) -> float:
        if self._cuda:
            torch.cuda.synchronize()
        return time.perf_counter()
