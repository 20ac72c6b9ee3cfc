"""The order of travel: kept waypoints, gapless segments, and stretches before and after lines with the laser off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.planning.raster import RasterConfig, RasterPattern


@dataclass(frozen=True, eq=False)
class Path:
    """Waypoints in the order of travel; read-only.

    Attributes:
        source: number among the kept raster points whose pose a waypoint takes [N].
        shift_m: what is added to its position (x, y) [N, 2]; 0 but for lead-ins and lead-outs.
        segment: gapless stretch it belongs to [N], int32; a turn ends one, and so does a given-up raster point. A lead
            belongs to the segment that it leads into or out of.
        laser_on: whether it is a raster point, and no lead [N].
    """

    source: NDArray[np.intp]
    shift_m: NDArray[np.float64]
    segment: NDArray[np.int32]
    laser_on: NDArray[np.bool_]


def path_through(
    pattern: RasterPattern, kept: NDArray[np.intp], along: NDArray[np.float64], config: RasterConfig
) -> Path:
    """Run through the kept points of a raster, with a lead before and after what is kept of each of its lines.

    A lead is one waypoint at the line's own first or last depth, straight on in the line's direction.

    Args:
        pattern: the raster.
        kept: index of the raster points that are kept [M], in order.
        along: direction (x, y) of a line that has one point only.
        config: lengths of the leads.
    """
    line = pattern.segment[kept]
    starts = (np.diff(line) != 0) | (np.diff(kept) != 1)
    segment = np.concatenate(([0], np.cumsum(starts))).astype(np.int32)
    first = np.flatnonzero(np.insert(np.diff(line) != 0, 0, True))
    last = np.append(first[1:] - 1, len(kept) - 1)
    before = first if config.lead_in_m > 0.0 else first[:0]
    after = last if config.lead_out_m > 0.0 else last[:0]
    source = np.concatenate([before, np.arange(len(kept)), after])
    role = np.repeat([-1, 0, 1], [len(before), len(kept), len(after)])
    order = np.lexsort((role, source))
    source, role = source[order], role[order]
    length = np.where(role < 0, -config.lead_in_m, np.where(role > 0, config.lead_out_m, 0.0))
    shift = length[:, None] * _directions(pattern, along)[line[source]]
    return Path(source, shift, segment[source], role == 0)


def _directions(pattern: RasterPattern, along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit direction of travel (x, y) of each raster line."""
    first = np.searchsorted(pattern.segment, np.arange(pattern.segment[-1] + 1), side="left")
    last = np.append(first[1:], len(pattern.segment)) - 1
    way = pattern.points_m[last] - pattern.points_m[first]
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return np.where(length > 0.0, way / np.where(length > 0.0, length, 1.0), along)
