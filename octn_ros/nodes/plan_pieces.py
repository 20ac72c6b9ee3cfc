"""A plan as a person looks at it: straight coloured pieces between waypoints, and dots where it was given up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from octn_ros.planning import Plan

MOST_PIECES = 2000  # more are no clearer to look at, and each is two Python objects or more
MOST_DOTS = 2000
GIVEN_UP_COLOUR = (0.9, 0.1, 0.1, 1.0)
_OFF_COLOUR = (0.55, 0.55, 0.6, 0.8)
_DOUBTFUL, _SURE = np.array([1.0, 0.75, 0.0, 1.0]), np.array([0.1, 0.85, 0.45, 1.0])


@dataclass(frozen=True, eq=False)
class PlanPieces:
    """What of a plan is drawn; read-only.

    Attributes:
        pieces_m: both ends (x, y, z) [N, 2, 3] of straight pieces in the OCT frame, in the order of travel.
        colours: (red, green, blue, alpha) [N, 4]: from yellow (confidence 0) to green (1), grey with the laser off.
        given_up_m: places [M, 3] in the OCT frame of waypoints that were asked for and given up, in the depth of the
            nearest one that was not.
    """

    pieces_m: NDArray[np.float64]
    colours: NDArray[np.float64]
    given_up_m: NDArray[np.float64]


def plan_pieces(plan: Plan) -> PlanPieces:
    """Return what of a plan is drawn: at most `MOST_PIECES` pieces, the ends of segments kept as long as they can be.

    A piece is as sure as the less sure of its ends.
    """
    kept = _kept(plan.segment)
    start, end = kept[:-1], kept[1:]
    joined = plan.segment[start] == plan.segment[end]
    start, end = start[joined], end[joined]
    every = -(-len(start) // MOST_PIECES) if len(start) else 1
    start, end = start[::every], end[::every]
    places = plan.waypoints_oct[:, :3, 3]
    sure = np.clip(np.nan_to_num(np.minimum(plan.confidence[start], plan.confidence[end])), 0.0, 1.0)[:, None]
    on = (plan.laser_on[start] & plan.laser_on[end])[:, None]
    colours = np.where(on, _DOUBTFUL + sure * (_SURE - _DOUBTFUL), _OFF_COLOUR)
    return PlanPieces(np.stack([places[start], places[end]], axis=1), colours, _given_up(plan))


def _kept(segment: NDArray[np.int32]) -> NDArray[np.intp]:
    """Return which waypoints are drawn: all, or every few and the ends of each segment."""
    every = -(-len(segment) // MOST_PIECES)
    if every <= 1:
        return np.arange(len(segment))
    ends = np.ones(len(segment), dtype=bool)
    ends[1:-1] = (segment[1:-1] != segment[:-2]) | (segment[1:-1] != segment[2:])
    return np.flatnonzero(ends | (np.arange(len(segment)) % every == 0))


def _given_up(plan: Plan) -> NDArray[np.float64]:
    points = plan.given_up_points[:: max(1, -(-len(plan.given_up_points) // MOST_DOTS))]
    if not points:
        return np.empty((0, 3))
    places = np.array([(point.x_m, point.y_m) for point in points])
    _, nearest = cKDTree(plan.surface_m[:, :2]).query(places)
    return np.column_stack([places, plan.surface_m[nearest, 2]])
