"""Pictures as grids of square cells that lie somewhere in space, and back."""

from __future__ import annotations

import math
from array import array
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion
from nav_msgs.msg import OccupancyGrid
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from octn_ros.errors import QueryError
from octn_ros.nodes.conversions.headers import header
from octn_ros.volume import VolumeGeometry

LARGEST_GRID = 1 << 22  # cells of a grid: 4 MB on the wire
UNKNOWN = -1  # value of a cell without a grey level, as OccupancyGrid has it


class GridView(NamedTuple):
    """An OccupancyGrid as an array.

    Attributes:
        cells: grey levels 0 to 100 [rows, columns], `UNKNOWN` where there is none, int8.
        corner_m: outer corner (x, y) of cell (0, 0) in the grid's frame.
        cell_m: side of a cell.
    """

    cells: NDArray[np.int8]
    corner_m: tuple[float, float]
    cell_m: float


def to_grid(enface: NDArray[np.float32], geometry: VolumeGeometry, stamp_ns: int) -> OccupancyGrid:
    """Return an en-face view [bscan, lateral] in [0, 1] as a grid; see `picture_to_grid`."""
    along, _, across = geometry.spacing_m
    steps = (across, 0.0, 0.0), (0.0, along, 0.0)
    return picture_to_grid(enface, geometry.origin_m, *steps, stamp_ns, geometry.frame)


def picture_to_grid(
    pixels: NDArray[np.floating],
    origin_m: ArrayLike,
    along_m: ArrayLike,
    down_m: ArrayLike,
    stamp_ns: int,
    frame: str,
    levels: tuple[float, float] = (0.0, 1.0),
) -> OccupancyGrid:
    """Return a flat picture anywhere in space as a grid of square cells with grey levels 0 to 100.

    Cells are as small as the finer of the two pixel distances, coarser where there would be more than `LARGEST_GRID`
    of them; each shows the pixel nearest its centre. The centre of cell (0, 0) is that of pixel (0, 0); columns run
    along x of the grid's own axes and rows along y.

    Args:
        pixels: values [rows, columns], NaN where there are none.
        origin_m: centre (x, y, z) of pixel (0, 0) in `frame`.
        along_m: from one column to the next.
        down_m: from one row to the next, at a right angle to `along_m`.
        stamp_ns: acquisition time.
        frame: the frame's name.
        levels: the values that become 0 and 100; what lies beyond takes the nearer of them.
    """
    origin, along, down = (np.asarray(vector, dtype=np.float64) for vector in (origin_m, along_m, down_m))
    across_m, along_rows_m = float(np.linalg.norm(along)), float(np.linalg.norm(down))
    area = pixels.shape[0] * along_rows_m * pixels.shape[1] * across_m
    cell = max(min(across_m, along_rows_m), math.sqrt(area / LARGEST_GRID))
    rows, columns = _nearest(pixels.shape[0], along_rows_m, cell), _nearest(pixels.shape[1], across_m, cell)
    values = pixels[np.ix_(rows, columns)]
    low, high = levels
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    cells = np.where(np.isnan(share), UNKNOWN, np.rint(np.nan_to_num(share) * 100.0)).astype(np.int8)
    x, y = along / across_m, down / along_rows_m
    grid = OccupancyGrid(header=header(stamp_ns, frame))
    grid.info.map_load_time = grid.header.stamp
    grid.info.resolution = cell
    grid.info.width, grid.info.height = len(columns), len(rows)
    # The grid's origin is the corner of its first cell, whose centre is that of the first pixel.
    corner = [float(value) for value in origin - 0.5 * cell * (x + y)]
    turn = [float(value) for value in Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)])).as_quat()]
    grid.info.origin = Pose(
        position=Point(x=corner[0], y=corner[1], z=corner[2]),
        orientation=Quaternion(x=turn[0], y=turn[1], z=turn[2], w=turn[3]),
    )
    data = array("b")
    data.frombytes(cells.tobytes())
    grid.data = data
    return grid


def grid_to_view(message: OccupancyGrid) -> GridView:
    """Return a grid that lies along the axes of its frame, such as `enface`, as an array.

    Raises:
        QueryError: its size disagrees with its data, its cells have no size, or it is turned.
    """
    info, turn = message.info, message.info.origin.orientation
    if info.width * info.height != len(message.data) or not len(message.data):
        raise QueryError(f"expected {info.width} x {info.height} cells of a grid, got {len(message.data)}")
    if not (math.isfinite(info.resolution) and info.resolution > 0.0):
        raise QueryError(f"expected cells of a positive size, got {info.resolution} m")
    if abs(turn.x) + abs(turn.y) + abs(turn.z) > 1e-6:
        raise QueryError(f"expected a grid along the axes of its frame, got one turned by {turn}")
    cells = np.frombuffer(message.data, np.int8).reshape(info.height, info.width)
    place = info.origin.position
    return GridView(cells, (float(place.x), float(place.y)), float(info.resolution))


def _nearest(samples: int, spacing: float, cell: float) -> NDArray[np.intp]:
    count = max(1, round((samples - 1) * spacing / cell) + 1)
    return np.minimum(np.rint(np.arange(count) * (cell / spacing)), samples - 1).astype(np.intp)
