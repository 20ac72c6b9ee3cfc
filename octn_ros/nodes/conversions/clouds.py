"""Structured arrays as point clouds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

from octn_ros.nodes.conversions.buffers import to_bytes_field
from octn_ros.nodes.conversions.headers import header

_DATATYPES = {"<f4": PointField.FLOAT32, "<u4": PointField.UINT32, "|u1": PointField.UINT8}


def columns(dtype: np.dtype[Any]) -> dict[str, tuple[int, int]]:
    """Return offset and PointField datatype of each column of a structured type of float32, uint32 and uint8."""
    return {name: (int(column[1]), _DATATYPES[column[0].str]) for name, column in (dtype.fields or {}).items()}


def to_cloud(rows: NDArray[np.void], stamp_ns: int, frame: str) -> PointCloud2:
    """Return a structured array [N] of float32, uint32 and uint8 columns as an unordered point cloud.

    It is dense, as PointCloud2 means it, if every number is finite; a tool path with leads is not.
    """
    fields = [
        PointField(name=name, offset=offset, datatype=datatype, count=1)
        for name, (offset, datatype) in columns(rows.dtype).items()
    ]
    return PointCloud2(
        header=header(stamp_ns, frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * len(rows),
        data=to_bytes_field(rows.tobytes()),
        is_dense=all(np.isfinite(rows[name]).all() for name in rows.dtype.names or ()),
    )
