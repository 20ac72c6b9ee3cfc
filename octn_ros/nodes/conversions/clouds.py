"""Structured arrays as point clouds, and the points of anyone's cloud."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

from octn_ros.errors import QueryError
from octn_ros.nodes.conversions.buffers import to_bytes_field
from octn_ros.nodes.conversions.headers import header

_DATATYPES = {"<f4": PointField.FLOAT32, "<u4": PointField.UINT32, "|u1": PointField.UINT8}
_COORDINATES = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}


def columns(dtype: np.dtype[Any]) -> dict[str, tuple[int, int]]:
    """Return offset and PointField datatype of each column of a structured type of float32, uint32 and uint8."""
    return {name: (int(column[1]), _DATATYPES[column[0].str]) for name, column in (dtype.fields or {}).items()}


def table(names: tuple[str, ...], *parts: NDArray[Any]) -> NDArray[np.void]:
    """Return named float32 columns [N] as a structured array; each part is a column [N] or several [N, K]."""
    rows = np.empty(len(parts[0]), [(name, "<f4") for name in names])
    for name, column in zip(names, np.column_stack(parts).T, strict=True):
        rows[name] = column
    return rows


def to_cloud(rows: NDArray[np.void], stamp_ns: int, frame: str, height: int = 1) -> PointCloud2:
    """Return a structured array [N] of float32, uint32 and uint8 columns as a point cloud.

    It is dense, as PointCloud2 means it, if every number is finite; a tool path with leads is not.

    Args:
        rows: the points.
        stamp_ns: acquisition time.
        frame: the frame's name.
        height: rows of an organised cloud, whose points follow each other row by row; 1 for an unordered one.
    """
    fields = [
        PointField(name=name, offset=offset, datatype=datatype, count=1)
        for name, (offset, datatype) in columns(rows.dtype).items()
    ]
    width = len(rows) // height
    return PointCloud2(
        header=header(stamp_ns, frame),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * width,
        data=to_bytes_field(rows.tobytes()),
        is_dense=all(np.isfinite(rows[name]).all() for name in rows.dtype.names or ()),
    )


def cloud_to_points(message: PointCloud2, most: int) -> NDArray[np.float64]:
    """Return the coordinates (x, y, z) [N, 3] of a cloud of any layout and byte order, row by row.

    Args:
        message: has float32 or float64 columns x, y and z, and any others; N may be 0.
        most: largest number of points; nothing is allocated for more.

    Raises:
        QueryError: there are more points, a coordinate is missing or of another type, or the sizes disagree.
    """
    count, step = message.width * message.height, message.point_step
    if count > most:
        raise QueryError(f"expected at most {most:,} points, got {count:,}; ask for them in parts")
    found = {field.name: field for field in message.fields if field.name in ("x", "y", "z")}
    wrong = [f"{name}: {field.datatype}" for name, field in found.items() if field.datatype not in _COORDINATES]
    if len(found) != 3 or wrong or any(field.count > 1 for field in found.values()):
        raise QueryError(
            f"expected a cloud with the columns x, y, z of float32 or float64, got {[f.name for f in message.fields]}"
            + (f" with datatypes {wrong}" if wrong else "")
        )
    order = ">" if message.is_bigendian else "<"
    types = [f"{order}{_COORDINATES[found[name].datatype]}" for name in "xyz"]
    offsets = [found[name].offset for name in "xyz"]
    ends = [offset + int(kind[-1]) for offset, kind in zip(offsets, types, strict=True)]
    row_step = message.row_step or step * message.width  # some leave it out of an unordered cloud
    if max(ends) > step or row_step < step * message.width or len(message.data) != row_step * message.height:
        raise QueryError(
            f"expected {message.height} rows of {message.width} points of {step} bytes that hold x, y and z, got rows "
            f"of {row_step} bytes and {len(message.data)} bytes in all"
        )
    if not count:
        return np.empty((0, 3))
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, row_step)[:, : step * message.width]
    kind = np.dtype({"names": ["x", "y", "z"], "formats": types, "offsets": offsets, "itemsize": step})
    points = np.ascontiguousarray(rows).reshape(-1).view(kind)
    return np.column_stack([points[name].astype(np.float64) for name in "xyz"])
