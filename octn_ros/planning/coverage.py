"""How densely a path covers its region, as computed figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import PlanError
from octn_ros.planning.region import Region

_EVEN_COLUMNS, _MAX_COLUMNS = 256, 4096
# Columns run this far beside the ends of lines and the corners of the region, where gaps change by leaps.
_BESIDE_M = 1e-9


@dataclass(frozen=True)
class Coverage:
    """Gaps of a path over its region less the margin; lengths in metres.

    A column runs across the lines. Between its two crossings of the border, each stretch from border to line, line to
    line and line to border is a gap.

    Attributes:
        lines: number of stretches that the laser covers without a pause.
        line_gap_m: widest lateral gap between neighbouring lines.
        border_gap_m: widest lateral gap between the border and the line nearest to it.
        point_gap_m: widest lateral distance between neighbouring waypoints of a line.
        surface_line_gap_m: as `line_gap_m`, straight from surface to surface.
        surface_border_gap_m: as `border_gap_m`, with the slope of the gap beside it, since no depth is known there.
        surface_point_gap_m: as `point_gap_m`, straight from surface to surface.
        open_share: share of the region that lies in gaps wider than the line spacing, such as at given-up waypoints.
        path_m: length of all lines on the surface.
        area_m2: lateral area of the region less the margin.
    """

    lines: int
    line_gap_m: float
    border_gap_m: float
    point_gap_m: float
    surface_line_gap_m: float
    surface_border_gap_m: float
    surface_point_gap_m: float
    open_share: float
    path_m: float
    area_m2: float


def measure_coverage(
    region: Region, points_m: NDArray[np.floating], segment: NDArray[np.integer], line_spacing_m: float
) -> Coverage:
    """Measure the gaps of a path, in columns at the ends of all its lines and evenly between (4096 at most).

    Args:
        region: what was to be covered, with its margin.
        points_m: waypoints on the surface (x, y, z) [N, 3] in the OCT frame, or (x, y) [N, 2] of a flat one.
        segment: gapless stretch that each waypoint belongs to [N].
        line_spacing_m: gaps wider than this are open.

    Raises:
        PlanError: there are no waypoints, or the shapes differ.
    """
    points = np.asarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) == 0 or len(segment) != len(points):
        raise PlanError(f"expected points [N, 2 or 3] with N > 0 and segments [N], got {points.shape}, {len(segment)}")
    depth = points[:, 2] if points.shape[1] == 3 else np.zeros(len(points))
    place = np.column_stack([region.to_uv(points[:, :2]), depth])
    same = segment[1:] == segment[:-1]
    pieces = np.stack([place[:-1][same], place[1:][same]], axis=1)
    lateral = np.linalg.norm(np.diff(pieces[..., :2], axis=1)[:, 0], axis=-1)
    length = np.linalg.norm(np.diff(pieces, axis=1)[:, 0], axis=-1)

    columns = _columns(region, place, segment)
    gaps = _Gaps.across(region, columns, pieces)
    between = np.diff(columns)
    width = 0.5 * (np.append(between, 0.0) + np.insert(between, 0, 0.0))[gaps.column] * gaps.lateral
    open_ = gaps.lateral > line_spacing_m * (1.0 + 1e-6) + 4 * _BESIDE_M
    return Coverage(
        lines=len(np.unique(segment)),
        line_gap_m=_largest(gaps.lateral[~gaps.at_border]),
        border_gap_m=_largest(gaps.lateral[gaps.at_border]),
        point_gap_m=_largest(lateral),
        surface_line_gap_m=_largest((gaps.lateral * gaps.stretch)[~gaps.at_border]),
        surface_border_gap_m=_largest((gaps.lateral * gaps.stretch)[gaps.at_border]),
        surface_point_gap_m=_largest(length),
        open_share=float(width[open_].sum() / width.sum()) if width.sum() > 0 else 0.0,
        path_m=float(length.sum()),
        area_m2=float(width.sum()),
    )


@dataclass(frozen=True, eq=False)
class _Gaps:
    """All gaps: their column, lateral width, stretch on the surface, and whether they touch the border."""

    column: NDArray[np.intp]
    lateral: NDArray[np.float64]
    stretch: NDArray[np.float64]
    at_border: NDArray[np.bool_]

    @classmethod
    def across(cls, region: Region, columns: NDArray[np.float64], pieces: NDArray[np.float64]) -> _Gaps:
        """Cut every column at the border and at every piece [P, 2, (u, v, z)] of the path that it crosses."""
        spans = region.column_spans(columns)
        border = np.concatenate([np.zeros((0, 2)), *spans])
        of_border = np.repeat(np.arange(len(columns)), [len(span) for span in spans])
        hit, v, z = _crossings(columns, pieces)
        # A line on the border lies inside: the border is moved out by less than anything that counts.
        column = np.concatenate([of_border, of_border, hit])
        at = np.concatenate([border[:, 0] - _BESIDE_M, border[:, 1] + _BESIDE_M, v])
        depth = np.concatenate([np.full(2 * len(border), np.nan), z])
        kind = np.repeat([-1, 1, 0], [len(border), len(border), len(hit)])  # into the region, out of it, a line
        order = np.lexsort((kind, at, column))
        column, at, depth, kind = column[order], at[order], depth[order], kind[order]
        inside = (column[1:] == column[:-1]) & (kind[:-1] != 1) & (kind[1:] != -1)
        at_border = (kind[:-1] == -1) | (kind[1:] == 1)
        gap = np.maximum(np.diff(at) - _BESIDE_M * ((kind[:-1] == -1).astype(float) + (kind[1:] == 1)), 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            stretch = np.hypot(gap, np.diff(depth)) / gap
        stretch = np.where(at_border | ~inside | (gap < _BESIDE_M), 1.0, stretch)
        beside = np.maximum(np.append(stretch[1:], 1.0), np.insert(stretch[:-1], 0, 1.0))
        stretch = np.where(at_border, beside, stretch)
        return cls(column[:-1][inside], gap[inside], stretch[inside], at_border[inside])


def _columns(region: Region, place: NDArray[np.float64], segment: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return u of the columns, in order: beside every end of a line and every corner, and evenly between them."""
    ends = np.flatnonzero(np.diff(segment) != 0)
    u = np.concatenate([place[[0, -1], 0], place[ends, 0], place[ends + 1, 0]])
    corners = region.to_uv(region.vertices_m)[:, 0]
    low, high = corners.min() + region.margin_m, corners.max() - region.margin_m
    events = np.unique(np.concatenate([u, corners]))
    events = np.unique(np.concatenate([events - _BESIDE_M, events + _BESIDE_M, np.linspace(low, high, _EVEN_COLUMNS)]))
    events = events[(events > low) & (events < high)]
    if len(events) > _MAX_COLUMNS:
        events = events[np.linspace(0, len(events) - 1, _MAX_COLUMNS).astype(np.intp)]
    return events if len(events) > 1 else np.array([low, high])


def _crossings(
    columns: NDArray[np.float64], pieces: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Return column, v and z of every crossing of a column with a piece."""
    order = np.argsort(pieces[:, :, 0], axis=1)[:, :, None]
    start, end = np.take_along_axis(pieces, order, axis=1).transpose(1, 0, 2)
    first = np.searchsorted(columns, start[:, 0], side="left")
    count = np.maximum(np.searchsorted(columns, end[:, 0], side="right") - first, 0)
    piece = np.repeat(np.arange(len(pieces)), count)
    column = first[piece] + np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    run = np.maximum(end[piece, 0] - start[piece, 0], 1e-30)
    share = ((columns[column] - start[piece, 0]) / run)[:, None]
    place = start[piece] + share * (end[piece] - start[piece])
    return column, place[:, 1], place[:, 2]


def _largest(values: NDArray[np.float64]) -> float:
    return float(values.max()) if len(values) else 0.0
