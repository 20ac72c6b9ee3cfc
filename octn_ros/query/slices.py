"""Flat cuts through a field: along its axes at any position, and along any plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.query.lattice import LARGEST_PLANE, canonical_index

# Directions of a plane further than this from a right angle are not what their author meant.
_SQUARE = 1e-3
_CHUNK_POINTS = 1 << 18


def bscan_slice(field: Field, position: float) -> NDArray[np.float32]:
    """Return one B-scan of a field, between the acquired ones too.

    Not differentiable; thread-safe; any device.

    Args:
        field: the field to look at.
        position: B-scan index, whole or fractional, from 0 to the number of B-scans less one.

    Returns:
        Intensities [axial, lateral] at the native axial and lateral voxels.

    Raises:
        QueryError: the position lies outside the scan.
    """
    return _cut(field, 0, position, "bscan_slice", "B-scan position")[0]


def axial_slice(field: Field, position: float) -> NDArray[np.float32]:
    """Return the en-face cut of a field at one depth.

    Not differentiable; thread-safe; any device.

    Args:
        field: the field to look at.
        position: axial voxel index, whole or fractional, 0 nearest the probe.

    Returns:
        Intensities [bscan, lateral] at the native voxels.

    Raises:
        QueryError: the position lies outside the scan.
    """
    return _cut(field, 1, position, "axial_slice", "axial position")[:, 0, :]


def lateral_slice(field: Field, position: float) -> NDArray[np.float32]:
    """Return the cut of a field across its B-scans at one lateral position.

    Not differentiable; thread-safe; any device.

    Args:
        field: the field to look at.
        position: lateral voxel index, whole or fractional.

    Returns:
        Intensities [axial, bscan] at the native voxels, the probe at the top as in a B-scan.

    Raises:
        QueryError: the position lies outside the scan.
    """
    return np.ascontiguousarray(_cut(field, 2, position, "lateral_slice", "lateral position")[:, :, 0].T)


@dataclass(frozen=True)
class Plane:
    """A rectangle of square cells anywhere in the OCT frame; immutable.

    Attributes:
        origin_m: centre (x, y, z) of cell (0, 0) in metres.
        along: direction in which columns follow each other, of any length; made a unit vector.
        down: direction in which rows follow each other, at a right angle to `along` within 1e-3; made exactly so.
        size_m: width along `along` and height along `down` between the first and last cells' centres.
        step_m: metres between cells, in both directions.

    Raises:
        QueryError: a number is not finite, a direction has no length, they are not at a right angle, or the plane has
            no cells or too many.
    """

    origin_m: tuple[float, float, float]
    along: tuple[float, float, float]
    down: tuple[float, float, float]
    size_m: tuple[float, float]
    step_m: float

    def __post_init__(self) -> None:
        numbers = (*self.origin_m, *self.along, *self.down, *self.size_m, self.step_m)
        if len(numbers) != 12 or not all(math.isfinite(number) for number in numbers):
            raise QueryError(f"plane: expected finite coordinates, directions, size and step, got {numbers}")
        if not (min(self.size_m) >= 0.0 and self.step_m > 0.0):
            raise QueryError(
                f"plane: expected a size of 0 m or more and a step above 0 m, got {self.size_m} and {self.step_m}"
            )
        along, down = np.array(self.along, dtype=np.float64), np.array(self.down, dtype=np.float64)
        lengths = np.linalg.norm(along), np.linalg.norm(down)
        if min(lengths) == 0.0:
            raise QueryError(f"plane: expected two directions, got {self.along} and {self.down}")
        along, down = along / lengths[0], down / lengths[1]
        lean = float(along @ down)
        if abs(lean) > _SQUARE:
            raise QueryError(
                f"plane: expected directions at a right angle within {_SQUARE:g}, got {self.along} and {self.down}, "
                f"whose angle is {math.degrees(math.acos(min(max(lean, -1.0), 1.0))):.2f} degrees"
            )
        down = down - lean * along
        object.__setattr__(self, "along", tuple(along.tolist()))
        object.__setattr__(self, "down", tuple((down / np.linalg.norm(down)).tolist()))
        # Compared as floats: a size over a tiny step may be no integer at all.
        if math.prod(size / self.step_m + 1.0 for size in self.size_m) > LARGEST_PLANE:
            raise QueryError(f"plane: expected at most {LARGEST_PLANE:,} cells; take a larger step or a smaller size")

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along (down, along) = rows and columns of the picture."""
        width, height = (math.floor(size / self.step_m + 1e-6) + 1 for size in self.size_m)
        return height, width

    def points_m(self, rows: slice = slice(None)) -> NDArray[np.float64]:
        """Return the centres [rows, columns, 3] of the cells in the OCT frame in metres."""
        height, width = self.shape
        row = np.arange(height)[rows, None, None] * self.step_m * np.array(self.down)
        column = np.arange(width)[None, :, None] * self.step_m * np.array(self.along)
        return np.asarray(np.array(self.origin_m) + row + column)


def plane_slice(field: Field, plane: Plane) -> NDArray[np.float32]:
    """Return the cut of a field along any plane.

    Not differentiable; thread-safe; any device.

    Args:
        field: the field to look at.
        plane: where, and how fine.

    Returns:
        Intensities [rows, columns] of the plane's cells, NaN where a cell's centre lies outside the scan.

    Raises:
        QueryError: no cell lies inside the scan.
    """
    geometry = field.geometry
    height, width = plane.shape
    picture = np.full((height, width), np.nan, dtype=np.float32)
    step = max(1, _CHUNK_POINTS // width)
    for start in range(0, height, step):
        rows = slice(start, start + step)
        canonical = geometry.metric_to_canonical(plane.points_m(rows))
        inside = (np.abs(canonical) <= 1.0 + 1e-9).all(axis=-1)
        if inside.any():
            points = torch.from_numpy(canonical[inside].astype(np.float32)).to(field.device)
            with torch.no_grad():
                picture[rows][inside] = field.evaluate(points).cpu().numpy()
    if np.isnan(picture).all():
        low, high = np.array(geometry.origin_m) * 1e3, (np.array(geometry.origin_m) + geometry.extent_m) * 1e3
        raise QueryError(
            f"plane_slice: expected a plane that cuts the scan, which spans {low.round(6).tolist()} to "
            f"{high.round(6).tolist()} mm along (x, y, z), got one whose cells all lie outside"
        )
    return picture


def _cut(field: Field, axis: int, position: float, query: str, what: str) -> NDArray[np.float32]:
    """Evaluate the voxels [bscan, axial, lateral] of a field with one index replaced by a position."""
    count = field.geometry.shape[axis]
    if not 0.0 <= position <= count - 1:
        raise QueryError(f"{query}: expected a {what} from 0 to {count - 1}, got {position}")
    indices = [np.full(1, position) if a == axis else np.arange(n) for a, n in enumerate(field.geometry.shape)]
    bscan, axial, lateral = (
        canonical_index(index, n, field.device) for index, n in zip(indices, field.geometry.shape, strict=True)
    )
    return np.asarray(field.lattice(lateral, axial, bscan).cpu().numpy())
