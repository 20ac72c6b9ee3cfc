"""Regular points over a scan, where a field is looked at: the voxels themselves, or every so many metres."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.query.regions import Region
from octn_ros.volume import Volume, VolumeGeometry

Source = Field | Volume
# Points of one slab: 16 MB of float32, and a few times that for temporaries.
SLAB_POINTS = 1 << 22
# More would take hours, or more memory for one plane than a slab may have.
LARGEST_LATTICE, LARGEST_PLANE = 1 << 32, 1 << 26
# Coordinates that differ from a border by less than this share of a voxel lie on it.
_ON_BORDER = 1e-6


@dataclass(frozen=True, eq=False)
class Lattice:
    """Points [bscan, axial, lateral] over a scan or a part of it; immutable.

    Attributes:
        geometry: of the scan.
        bscan: fractional voxel indices of the planes [bscan].
        axial: those of the rows [axial].
        lateral: those of the columns [lateral].
        native: whether the points are the voxels themselves.
    """

    geometry: VolumeGeometry
    bscan: NDArray[np.float64]
    axial: NDArray[np.float64]
    lateral: NDArray[np.float64]
    native: bool

    @classmethod
    def over(
        cls, geometry: VolumeGeometry, region: Region | None = None, step_m: float | None = None, *, name: str
    ) -> Lattice:
        """Lay a lattice over the part of a scan that a region may touch.

        It starts at the first voxel of the scan, whatever the region, so that lattices of equal step share points.

        Args:
            geometry: of the scan.
            region: only the points in the box around it are kept; None for the whole scan.
            step_m: metres between points along every axis; None for the voxels themselves.
            name: of the query, for its errors.

        Raises:
            QueryError: the step is not a positive number, or no point is left.
        """
        if step_m is not None and not (math.isfinite(step_m) and step_m > 0.0):
            raise QueryError(f"{name}: expected a lattice step above 0 m, got {step_m}")
        low, high = region.bounds_m() if region else (np.full(3, -np.inf), np.full(3, np.inf))
        axes: list[NDArray[np.float64]] = []
        # Bounds are (x, y, z) = (lateral, bscan, axial).
        for axis, place in enumerate((1, 2, 0)):
            spacing, origin, count = geometry.spacing_m[axis], geometry.origin_m[place], geometry.shape[axis]
            step = 1.0 if step_m is None else step_m / spacing
            first = max((low[place] - origin) / spacing, 0.0)
            last = min((high[place] - origin) / spacing, count - 1.0)
            if not first <= last:
                box = ", ".join(f"{a * 1e3:.3f} to {b * 1e3:.3f}" for a, b in zip(low, high, strict=True))
                raise QueryError(
                    f"{name}: expected a region that touches the scan, got one that spans {box} mm along (x, y, z); "
                    f"the scan begins at {tuple(round(o * 1e3, 6) for o in geometry.origin_m)} mm and spans "
                    f"{tuple(round(e * 1e3, 6) for e in geometry.extent_m)} mm"
                )
            begin = math.ceil(first / step - _ON_BORDER)
            end = math.floor(last / step + _ON_BORDER)
            if end < begin:
                raise QueryError(f"{name}: expected a region that holds lattice points, got one that lies between them")
            if end - begin >= LARGEST_PLANE:
                raise QueryError(
                    f"{name}: expected at most {LARGEST_PLANE:,} points along an axis, got {end - begin:,}"
                )
            axes.append(np.minimum(np.arange(begin, end + 1) * step, count - 1.0))
        points, plane = math.prod(map(len, axes)), len(axes[1]) * len(axes[2])
        if points > LARGEST_LATTICE or plane > LARGEST_PLANE:
            raise QueryError(
                f"{name}: expected at most {LARGEST_LATTICE:,} lattice points and {LARGEST_PLANE:,} in a plane, got "
                f"{points:,} and {plane:,}; take a larger step or a smaller region"
            )
        return cls(geometry, axes[0], axes[1], axes[2], step_m is None)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Points along (bscan, axial, lateral)."""
        return len(self.bscan), len(self.axial), len(self.lateral)

    @property
    def size(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    def axes_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return x [lateral], y [bscan] and z [axial] of the points in metres of the OCT frame."""
        (d, h, w), (x, y, z) = self.geometry.spacing_m, self.geometry.origin_m
        return self.lateral * w + x, self.bscan * d + y, self.axial * h + z

    def slabs(self, points: int = SLAB_POINTS) -> Iterator[slice]:
        """Yield runs of planes that cover the lattice, each of at most `points` points or one plane."""
        step = max(1, points // (len(self.axial) * len(self.lateral)))
        for start in range(0, len(self.bscan), step):
            yield slice(start, min(start + step, len(self.bscan)))

    def evaluate(self, source: Source, planes: slice = slice(None)) -> NDArray[np.float32]:
        """Return intensities [planes, axial, lateral] of a field, or of a measured volume at its own voxels.

        Raises:
            QueryError: a volume is asked for points between its voxels.
        """
        if isinstance(source, Volume):
            return self._voxels(source, planes)
        lateral, axial, bscan = (
            canonical_index(index, count, source.device)
            for index, count in zip(
                (self.lateral, self.axial, self.bscan[planes]), np.array(self.geometry.shape)[[2, 1, 0]], strict=True
            )
        )
        with torch.no_grad():
            values: NDArray[np.float32] = source.lattice(lateral, axial, bscan).cpu().numpy()
        return values

    def _voxels(self, volume: Volume, planes: slice) -> NDArray[np.float32]:
        if not self.native:
            raise QueryError(
                "expected the voxels' own lattice for a measured volume, got another step; take an InterpolatedField"
            )
        bscan, axial, lateral = (
            slice(round(axis[0]), round(axis[-1]) + 1) for axis in (self.bscan[planes], self.axial, self.lateral)
        )
        return volume.normalized((bscan, axial, lateral))


def lattice_size(width_m: float, height_m: float, voxels: tuple[int, int], most: int) -> tuple[int, int]:
    """Choose columns and rows of A-scans of about equal step in metres.

    Args:
        width_m: width of what they cover.
        height_m: its height.
        voxels: columns and rows of voxels in it; the lattice is no finer.
        most: largest number of A-scans, at least 4.
    """
    columns, rows = (max(count, 2) for count in voxels)
    if columns * rows <= most:
        return columns, rows
    wanted = min(max(round(math.sqrt(most * width_m / height_m)), 2), columns, most // 2)
    rows = min(max(most // wanted, 2), rows)
    return min(columns, max(most // rows, 2)), rows


def canonical_index(index: NDArray[np.number], count: int, device: torch.device) -> torch.Tensor:
    """Return the canonical coordinates, float32, of fractional voxel indices along an axis of `count` voxels."""
    return torch.from_numpy((index * (2.0 / (count - 1)) - 1.0).astype(np.float32)).to(device)
