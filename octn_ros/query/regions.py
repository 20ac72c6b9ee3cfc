"""Regions of the OCT frame: box, sphere, en-face polygon, and what they make together."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError

Coordinates = NDArray[np.float64]
Mask = NDArray[np.bool_]
Bounds = tuple[NDArray[np.float64], NDArray[np.float64]]


class Region(ABC):
    """A part of the OCT frame; immutable. `a & b`, `a | b` and `~a` are regions too."""

    @abstractmethod
    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        """Return which points lie inside or on the border.

        Args:
            x_m, y_m, z_m: coordinates in the OCT frame that broadcast together; the axes of a lattice may be given
                as they are, and the answer then broadcasts to the lattice.
        """

    @abstractmethod
    def bounds_m(self) -> Bounds:
        """Return the corners (low, high) [3] of a box that holds the region; infinite where it has no end."""

    def __and__(self, other: Region) -> Region:
        return _Both(self, other)

    def __or__(self, other: Region) -> Region:
        return _Either(self, other)

    def __invert__(self) -> Region:
        return _Outside(self)


@dataclass(frozen=True)
class Box(Region):
    """A box along the axes of the OCT frame, borders included; a side may be infinite.

    Args:
        low_m: (x, y, z) of its lowest corner in metres.
        high_m: (x, y, z) of its highest corner.

    Raises:
        QueryError: a low coordinate is not below the high one.
    """

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        sides = zip(self.low_m, self.high_m, strict=False)
        if len(self.low_m) != 3 or len(self.high_m) != 3 or not all(low < high for low, high in sides):
            raise QueryError(
                f"box: expected corners (x, y, z) with low < high along each axis, got {self.low_m} to {self.high_m} m"
            )

    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        """Return which points lie inside or on the border; see Region."""
        (x0, y0, z0), (x1, y1, z1) = self.low_m, self.high_m
        return ((x_m >= x0) & (x_m <= x1)) & ((y_m >= y0) & (y_m <= y1)) & ((z_m >= z0) & (z_m <= z1))

    def bounds_m(self) -> Bounds:
        """Return the box itself."""
        return np.array(self.low_m, dtype=np.float64), np.array(self.high_m, dtype=np.float64)


@dataclass(frozen=True)
class Sphere(Region):
    """A ball, border included.

    Args:
        centre_m: (x, y, z) in the OCT frame in metres.
        radius_m: its radius.

    Raises:
        QueryError: the centre is not finite or the radius not positive.
    """

    centre_m: tuple[float, float, float]
    radius_m: float

    def __post_init__(self) -> None:
        numbers = (*self.centre_m, self.radius_m)
        if len(self.centre_m) != 3 or not all(map(math.isfinite, numbers)) or not self.radius_m > 0.0:
            raise QueryError(
                f"sphere: expected a finite centre (x, y, z) and a radius above 0, got {self.centre_m} and "
                f"{self.radius_m} m"
            )

    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        """Return which points lie inside or on the border; see Region."""
        x, y, z = self.centre_m
        return np.asarray((x_m - x) ** 2 + (y_m - y) ** 2 + (z_m - z) ** 2 <= self.radius_m**2)

    def bounds_m(self) -> Bounds:
        """Return the cube around the ball."""
        centre = np.array(self.centre_m, dtype=np.float64)
        return centre - self.radius_m, centre + self.radius_m


@dataclass(frozen=True)
class EnfacePolygon(Region):
    """Everything above and below a polygon in the en-face plane, of any depth.

    The polygon is closed by itself; where it crosses itself, the even-odd rule holds. A point exactly on an edge may
    count as either.

    Args:
        vertices_m: its corners (x, y) in the OCT frame in metres, three or more, either way round.

    Raises:
        QueryError: fewer than three corners, one that is not finite, or all on one line.
    """

    vertices_m: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        corners = np.array(self.vertices_m, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
            raise QueryError(f"polygon: expected three or more finite corners (x, y), got {self.vertices_m}")
        spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-9 * spread[0]:
            raise QueryError("polygon: expected corners that enclose an area, got all of them on one line")

    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        """Return which points lie inside; see Region. The depth is not looked at."""
        from skimage.measure import points_in_poly

        x, y = np.broadcast_arrays(x_m, y_m)
        inside = points_in_poly(np.column_stack([x.ravel(), y.ravel()]), np.array(self.vertices_m, dtype=np.float64))
        return np.asarray(inside).reshape(x.shape)

    def bounds_m(self) -> Bounds:
        """Return the rectangle around the polygon, without end in depth."""
        corners = np.array(self.vertices_m, dtype=np.float64)
        return np.append(corners.min(axis=0), -np.inf), np.append(corners.max(axis=0), np.inf)


@dataclass(frozen=True)
class _Both(Region):
    first: Region
    second: Region

    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        return self.first.contains(x_m, y_m, z_m) & self.second.contains(x_m, y_m, z_m)

    def bounds_m(self) -> Bounds:
        (low, high), (other_low, other_high) = self.first.bounds_m(), self.second.bounds_m()
        return np.maximum(low, other_low), np.minimum(high, other_high)


@dataclass(frozen=True)
class _Either(Region):
    first: Region
    second: Region

    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        return self.first.contains(x_m, y_m, z_m) | self.second.contains(x_m, y_m, z_m)

    def bounds_m(self) -> Bounds:
        (low, high), (other_low, other_high) = self.first.bounds_m(), self.second.bounds_m()
        return np.minimum(low, other_low), np.maximum(high, other_high)


@dataclass(frozen=True)
class _Outside(Region):
    region: Region

    def contains(self, x_m: Coordinates, y_m: Coordinates, z_m: Coordinates) -> Mask:
        return ~self.region.contains(x_m, y_m, z_m)

    def bounds_m(self) -> Bounds:
        return np.full(3, -np.inf), np.full(3, np.inf)


def polygon(vertices_m: Sequence[Sequence[float]] | NDArray[np.floating]) -> EnfacePolygon:
    """Return the en-face polygon of corners (x, y) [N, 2] in any array or list."""
    return EnfacePolygon(tuple((float(x), float(y)) for x, y in vertices_m))
