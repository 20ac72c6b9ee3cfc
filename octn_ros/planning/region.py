"""The region of the tissue that a raster fills: a rectangle or any simple polygon in the lateral plane."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.errors import PlanError
from octn_ros.planning.scanline import EMPTY_M, NOTHING_M, Spans, clipped_lines

MAX_VERTICES = 1000
_BORDER_SAMPLES, _BISECTIONS = 256, 50


@dataclass(frozen=True, eq=False)
class Region:
    """A simple polygon, convex or not, and the direction of the raster lines in it; read-only.

    Lines and polygon are described in (u, v): u along the lines, v across them, both in metres from the OCT frame's
    origin.

    Attributes:
        vertices_m: corners (x, y) [K, 2] in the OCT frame, in order around the polygon, the first not repeated.
        along: unit vector [2] of the first line's direction of travel.
        across: unit vector [2] from each line to the next, perpendicular to `along`.
        margin_m: the treated part is what lies at least this far inside the border (exact, by distance to the edges).

    Raises:
        PlanError: fewer than 3 or more than 1000 corners, one of them not finite, edges that cross, or no area.
    """

    vertices_m: NDArray[np.float64]
    along: NDArray[np.float64]
    across: NDArray[np.float64]
    margin_m: float = 0.0

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices_m, dtype=np.float64)
        if vertices.ndim != 2 or vertices.shape[1:] != (2,) or not 3 <= len(vertices) <= MAX_VERTICES:
            raise PlanError(
                f"expected a raster polygon of 3 to {MAX_VERTICES} corners (x, y), got an array of {vertices.shape}"
            )
        if not np.isfinite(vertices).all():
            bad = int(np.argmin(np.isfinite(vertices).all(axis=1)))
            raise PlanError(
                f"expected a raster polygon of finite numbers, got {vertices[bad].tolist()} at corner {bad}"
            )
        if not (math.isfinite(self.margin_m) and self.margin_m >= 0.0):
            raise PlanError(f"expected a raster margin of at least 0 m, got {self.margin_m}")
        object.__setattr__(self, "vertices_m", vertices)
        vertices.setflags(write=False)
        _refuse_crossing_edges(vertices)
        following = np.roll(vertices, -1, axis=0)
        area = 0.5 * abs(float(np.sum(vertices[:, 0] * following[:, 1] - vertices[:, 1] * following[:, 0])))
        if area < NOTHING_M * float(np.ptp(vertices, axis=0).max()):
            raise PlanError(f"expected a raster polygon with an area, got {area * 1e6:.3g} mm^2")

    def inset(self, margin_m: float) -> Region:
        """Return the region with another margin."""
        return dataclasses.replace(self, margin_m=margin_m)

    def to_uv(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (u, v) [..., 2] of places (x, y) [..., 2]."""
        return np.stack([points_m @ self.along, points_m @ self.across], axis=-1)

    def to_xy(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places (x, y) [..., 2] in the OCT frame of u and v, broadcast together."""
        return u[..., None] * self.along + v[..., None] * self.across

    def line_spans(self, v: NDArray[np.float64]) -> Spans:
        """Return, for each line at v [M], the stretches (from, to) of u [S, 2] inside the treated part, in order."""
        return clipped_lines(self.to_uv(self.vertices_m), v, self.margin_m)

    def column_spans(self, u: NDArray[np.float64]) -> Spans:
        """Return, for each column at u [M], the stretches (from, to) of v [S, 2] inside the treated part, in order."""
        return clipped_lines(self.to_uv(self.vertices_m)[:, ::-1], u, self.margin_m)

    def line_range(self) -> tuple[float, float]:
        """Return the v of the first and the last line that touch the treated part.

        Raises:
            PlanError: the margin leaves nothing.
        """
        v = self.to_uv(self.vertices_m)[:, 1]
        low, high = float(v.min()), float(v.max())
        if self.margin_m <= 0.0:
            return low, high
        samples = np.linspace(low, high, _BORDER_SAMPLES)
        filled = np.flatnonzero([len(spans) > 0 for spans in self.line_spans(samples)])
        if len(filled) == 0:
            raise PlanError(
                f"expected a raster region wider than twice its margin of {self.margin_m * 1e6:.4g} um, got one of "
                f"which the margin leaves nothing; it is {(high - low) * 1e3:.3f} mm across its lines"
            )
        first = self._edge(samples[max(filled[0] - 1, 0)], samples[filled[0]])
        last = self._edge(samples[min(filled[-1] + 1, _BORDER_SAMPLES - 1)], samples[filled[-1]])
        # An edge along the lines is tilted by its rounding: just inside, the whole of it is met.
        inwards = min(NOTHING_M, 0.5 * (last - first))
        return first + inwards, last - inwards

    def _edge(self, empty: float, filled: float) -> float:
        """Bisect between a line that misses the treated part and one that meets it."""
        for _ in range(_BISECTIONS):
            middle = 0.5 * (empty + filled)
            if len(self.line_spans(np.array([middle]))[0]):
                filled = middle
            else:
                empty = middle
        return filled


def rectangle_corners(corner_m: ArrayLike, opposite_corner_m: ArrayLike, angle_rad: float) -> NDArray[np.float64]:
    """Return the four corners [4, 2] in order around a rectangle, the given ones at 0 and 2.

    Args:
        corner_m: one corner (x, y) in the OCT frame, in metres.
        opposite_corner_m: the corner across the diagonal.
        angle_rad: angle of the rectangle's first side against the lateral axis, towards the bscan axis.

    Raises:
        PlanError: a number is not finite, or a side of the rectangle has no length.
    """
    corner, opposite = np.asarray(corner_m, dtype=np.float64), np.asarray(opposite_corner_m, dtype=np.float64)
    if corner.shape != (2,) or opposite.shape != (2,):
        raise PlanError(f"expected two corners (x, y), got arrays of {corner.shape} and {opposite.shape}")
    if not (np.isfinite(corner).all() and np.isfinite(opposite).all() and math.isfinite(angle_rad)):
        raise PlanError(
            "expected a raster rectangle of finite numbers, "
            f"got corners {corner.tolist()} m and {opposite.tolist()} m, angle {angle_rad} rad"
        )
    first = _direction(angle_rad)
    second = np.array([-first[1], first[0]])
    diagonal = opposite - corner
    along, across = float(diagonal @ first), float(diagonal @ second)
    if min(abs(along), abs(across)) < EMPTY_M:
        raise PlanError(
            f"expected a raster rectangle with two sides, got {abs(along) * 1e3:.6g} x {abs(across) * 1e3:.6g} mm "
            f"between ({corner[0] * 1e3:.3f}, {corner[1] * 1e3:.3f}) mm and "
            f"({opposite[0] * 1e3:.3f}, {opposite[1] * 1e3:.3f}) mm at {math.degrees(angle_rad):.3g} degrees"
        )
    return np.stack([corner, corner + along * first, opposite, corner + across * second])


def rectangle_region(corner_m: ArrayLike, opposite_corner_m: ArrayLike, angle_rad: float = 0.0) -> Region:
    """Return a rectangle by its corners, with lines along its first side that begin at `corner_m`.

    Args:
        corner_m: where the path starts, (x, y) in the OCT frame, in metres.
        opposite_corner_m: the corner across the diagonal.
        angle_rad: angle of the first side against the lateral axis, towards the bscan axis.

    Raises:
        PlanError: a number is not finite, or a side of the rectangle has no length.
    """
    corners = rectangle_corners(corner_m, opposite_corner_m, angle_rad)
    side, other = corners[1] - corners[0], corners[3] - corners[0]
    return Region(corners, side / np.linalg.norm(side), other / np.linalg.norm(other))


def centred_rectangle_region(centre_m: ArrayLike, size_m: ArrayLike, angle_rad: float = 0.0) -> Region:
    """Return a rectangle by its centre, with lines along its first side.

    Args:
        centre_m: centre (x, y) in the OCT frame, in metres.
        size_m: lengths of the first and the second side.
        angle_rad: angle of the first side against the lateral axis, towards the bscan axis.

    Raises:
        PlanError: a number is not finite, or a side is not longer than nothing.
    """
    centre, size = np.asarray(centre_m, dtype=np.float64), np.asarray(size_m, dtype=np.float64)
    if centre.shape != (2,) or size.shape != (2,):
        raise PlanError(f"expected a centre (x, y) and two sides, got arrays of {centre.shape} and {size.shape}")
    if not (size > 0).all():
        raise PlanError(f"expected a raster rectangle with two sides above 0, got {size.tolist()} m")
    if not math.isfinite(angle_rad):
        raise PlanError(f"expected a raster rectangle of finite numbers, got the angle {angle_rad} rad")
    first = _direction(angle_rad)
    half = 0.5 * (size[0] * first + size[1] * np.array([-first[1], first[0]]))
    return rectangle_region(centre - half, centre + half, angle_rad)


def polygon_region(vertices_m: ArrayLike, angle_rad: float = 0.0) -> Region:
    """Return a polygon whose lines run at an angle against the lateral axis, the first one at its lowest corner.

    Args:
        vertices_m: corners (x, y) [K, 2] in the OCT frame, in metres, in order around it, clockwise or not; a last one
            equal to the first is dropped.
        angle_rad: angle of the lines against the lateral axis, towards the bscan axis.

    Raises:
        PlanError: see Region.
    """
    try:
        vertices = np.asarray(vertices_m, dtype=np.float64)
    except (TypeError, ValueError):
        raise PlanError(f"expected a raster polygon of corners (x, y) in numbers, got {vertices_m!r}") from None
    if not math.isfinite(angle_rad):
        raise PlanError(f"expected a finite angle of the raster lines, got {angle_rad} rad")
    if vertices.ndim == 2 and len(vertices) > 3 and np.array_equal(vertices[0], vertices[-1]):
        vertices = vertices[:-1]
    first = _direction(angle_rad)
    return Region(vertices, first, np.array([-first[1], first[0]]))


def _direction(angle_rad: float) -> NDArray[np.float64]:
    return np.array([math.cos(angle_rad), math.sin(angle_rad)])


def _refuse_crossing_edges(vertices: NDArray[np.float64]) -> None:
    """A polygon whose edges cross has no inside that everybody would agree on."""
    start, end = vertices, np.roll(vertices, -1, axis=0)
    edge = end - start
    if not (np.linalg.norm(edge, axis=1) > NOTHING_M).all():
        bad = int(np.argmin(np.linalg.norm(edge, axis=1)))
        raise PlanError(f"expected corners of a raster polygon apart from each other, got corner {bad} twice")

    def side(of: NDArray[np.float64]) -> NDArray[np.float64]:  # [edge, point]: left of the edge, right of it, or on it
        turn = edge[:, None, 0] * (of[None, :, 1] - start[:, None, 1]) - edge[:, None, 1] * (
            of[None, :, 0] - start[:, None, 0]
        )
        return np.sign(np.where(np.abs(turn) < NOTHING_M**2, 0.0, turn))

    parts = side(start) * side(end) < 0  # edge i has both ends of edge j on different sides
    crossing = np.argwhere(np.triu(parts & parts.T, 1))
    if len(crossing):
        first, second = crossing[0]
        raise PlanError(
            f"expected a simple raster polygon, got one whose edges after corner {first} and after corner {second} "
            "cross; list the corners in order around it"
        )
