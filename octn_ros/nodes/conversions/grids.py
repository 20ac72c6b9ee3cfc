"""Pictures as grids of square cells that lie somewhere in space."""

from __future__ import annotations

import math
from array import array

import numpy as np
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray

from octn_ros.nodes.conversions.headers import header
from octn_ros.volume import VolumeGeometry

LARGEST_GRID = 1 << 22  # cells of an en-face view: 4 MB on the wire


def to_grid(enface: NDArray[np.float32], geometry: VolumeGeometry, stamp_ns: int) -> OccupancyGrid:
    """Return an en-face view [bscan, lateral] in [0, 1] as a grid of square cells with grey levels 0 to 100.

    Cells are as small as the finer of the two spacings, coarser where there would be more than `LARGEST_GRID` of
    them; each shows the nearest A-scan. Cell (0, 0) lies at the first A-scan, rows run along the bscan axis.
    """
    along, _, across = geometry.spacing_m
    x0, y0, z0 = geometry.origin_m
    bscans, laterals = enface.shape
    area = bscans * along * laterals * across
    cell = max(min(along, across), math.sqrt(area / LARGEST_GRID))
    columns = _nearest(laterals, across, cell)
    rows = _nearest(bscans, along, cell)
    grey = np.rint(np.clip(enface[np.ix_(rows, columns)], 0.0, 1.0) * 100.0).astype(np.int8)
    grid = OccupancyGrid(header=header(stamp_ns, geometry.frame))
    grid.info.map_load_time = grid.header.stamp
    grid.info.resolution = float(cell)
    grid.info.width, grid.info.height = len(columns), len(rows)
    # The grid's origin is the corner of its first cell, whose centre lies over the first A-scan.
    grid.info.origin.position = Point(x=x0 - cell / 2, y=y0 - cell / 2, z=z0)
    data = array("b")
    data.frombytes(grey.tobytes())
    grid.data = data
    return grid


def _nearest(samples: int, spacing: float, cell: float) -> NDArray[np.intp]:
    count = max(1, round((samples - 1) * spacing / cell) + 1)
    return np.minimum(np.rint(np.arange(count) * (cell / spacing)), samples - 1).astype(np.intp)
