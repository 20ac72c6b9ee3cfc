"""Straight lines clipped to a polygon, convex or not, less a margin along its border."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Below a nanometre a difference is rounding; a rectangle with a side shorter than ten of them is empty.
NOTHING_M = 1e-9
EMPTY_M = 10 * NOTHING_M

Spans = list[NDArray[np.float64]]


def clipped_lines(corners: NDArray[np.float64], lines: NDArray[np.float64], margin: float) -> Spans:
    """Clip lines of constant second coordinate to a polygon less its margin, by the even-odd rule.

    Args:
        corners: of a simple polygon (u, v) [K, 2], in metres, in order around it.
        lines: v of each line [M].
        margin: distance that is kept from every edge, exact also around corners; 0 for none.

    Returns:
        For each line the stretches (from, to) of u [S, 2] that remain, in order; S may be 0.
    """
    low, high = corners[:, 1].min(), corners[:, 1].max()
    # A line on the border belongs to the polygon; half-open edges alone would drop the one at the top.
    at = np.clip(lines, low + NOTHING_M, high - NOTHING_M)[:, None] if high - low > 2 * NOTHING_M else lines[:, None]
    (u0, v0), (u1, v1) = corners.T, np.roll(corners, -1, axis=0).T
    crossed = (v0 <= at) != (v1 <= at)
    # Only edges that are not crossed divide by nothing, or by next to nothing, and those are not taken.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = np.sort(np.where(crossed, u0 + (at - v0) / (v1 - v0) * (u1 - u0), np.inf), axis=1)
    count = crossed.sum(axis=1)
    spans = [row[: 2 * (n // 2)].reshape(-1, 2) for row, n in zip(u, count, strict=True)]
    if margin <= 0.0:
        return spans
    cut_low, cut_high = _near_edges(corners, lines, margin * (1.0 - 1e-9))
    return [
        _without(span, np.column_stack([first, last])[last > first])
        for span, first, last in zip(spans, cut_low, cut_high, strict=True)
    ]


def _near_edges(
    corners: NDArray[np.float64], lines: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where each line [M] is closer than a radius to each edge [K]: first and last u [M, K], empty as (inf, -inf).

    The places near an edge are a stadium: two discs and the rectangle between them, convex, so one stretch each.
    """
    start, end = corners, np.roll(corners, -1, axis=0)
    edge = end - start
    normal = radius * np.column_stack([-edge[:, 1], edge[:, 0]]) / np.linalg.norm(edge, axis=1, keepdims=True)
    at = lines[:, None]
    first, last = np.full((len(lines), len(corners)), np.inf), np.full((len(lines), len(corners)), -np.inf)
    for centre in (start, end):
        height = at - centre[:, 1]
        half = np.sqrt(np.maximum(radius**2 - height**2, 0.0))
        inside = np.abs(height) < radius
        first = np.minimum(first, np.where(inside, centre[:, 0] - half, np.inf))
        last = np.maximum(last, np.where(inside, centre[:, 0] + half, -np.inf))
    sides = (start + normal, end + normal, end - normal, start - normal)
    for one, other in zip(sides, (*sides[1:], sides[0]), strict=True):
        crossed = (one[:, 1] < at) != (other[:, 1] < at)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = one[:, 0] + (at - one[:, 1]) / (other[:, 1] - one[:, 1]) * (other[:, 0] - one[:, 0])
        first = np.minimum(first, np.where(crossed, u, np.inf))
        last = np.maximum(last, np.where(crossed, u, -np.inf))
    return first, last


def _without(spans: NDArray[np.float64], cuts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what open cuts [C, 2] leave of spans [S, 2]."""
    cuts = cuts[np.argsort(cuts[:, 0])]
    left = []
    for first, last in spans:
        for cut_first, cut_last in cuts:
            if cut_last <= first:
                continue
            if cut_first >= last:
                break
            if cut_first > first:
                left.append((first, cut_first))
            first = cut_last
        if last >= first:
            left.append((first, last))
    return np.array(left).reshape(-1, 2)
