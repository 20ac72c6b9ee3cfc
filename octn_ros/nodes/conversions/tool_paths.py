"""A plan as a point cloud: what a PoseArray cannot say."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from octn_ros.errors import ExecutionError
from octn_ros.nodes.conversions.clouds import columns
from octn_ros.nodes.conversions.headers import stamp_to_ns
from octn_ros.nodes.conversions.poses import rigid_transforms
from octn_ros.planning import quaternions_xyzw

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
TOOL_PATH = np.dtype(
    [
        *((name, "<f4") for name in _POSE),
        ("segment", "<u4"),
        ("laser_on", "u1"),
        *((name, "<f4") for name in ("speed", "residual", "confidence")),
    ]
)


def tool_path(
    poses: NDArray[np.float64],
    segment: NDArray[Any],
    laser_on: NDArray[Any],
    speed_m_s: NDArray[Any],
    residual: NDArray[Any],
    confidence: NDArray[Any],
) -> NDArray[np.void]:
    """Return a plan as the structured array `TOOL_PATH` [N]: what a PoseArray cannot say."""
    rows = np.zeros(len(poses), TOOL_PATH)
    if len(poses):
        for name, column in zip(("x", "y", "z"), poses[:, :3, 3].T, strict=True):
            rows[name] = column
        for name, column in zip(("qx", "qy", "qz", "qw"), quaternions_xyzw(poses).T, strict=True):
            rows[name] = column
    rows["segment"], rows["laser_on"], rows["speed"] = segment, laser_on, speed_m_s
    rows["residual"], rows["confidence"] = residual, confidence
    return rows


def cloud_to_tool_path(message: PointCloud2) -> NDArray[np.void]:
    """Return a `tool_path` message as the structured array `TOOL_PATH` [N].

    Raises:
        ExecutionError: the columns or the amount of data are not those of a tool path.
    """
    sent = {field.name: (field.offset, field.datatype) for field in message.fields}
    wanted = columns(TOOL_PATH)
    count = message.width * message.height
    if sent != wanted or message.point_step != TOOL_PATH.itemsize or message.is_bigendian:
        order = "big-endian" if message.is_bigendian else "little-endian"
        raise ExecutionError(
            f"expected a tool path of little-endian rows of {TOOL_PATH.itemsize} bytes with the columns (offset, "
            f"datatype) {wanted}, got {order} rows of {message.point_step} bytes with {sent}"
        )
    if len(message.data) != count * TOOL_PATH.itemsize:
        raise ExecutionError(f"expected {count} waypoints of {TOOL_PATH.itemsize} bytes, got {len(message.data)} bytes")
    return np.frombuffer(bytes(message.data), TOOL_PATH)


def tool_path_poses(rows: NDArray[np.void]) -> NDArray[np.float64]:
    """Return the poses [N, 4, 4] of a tool path [N].

    Raises:
        ExecutionError: a coordinate is not finite, or a quaternion not of unit length within 1e-3.
    """
    return rigid_transforms(np.stack([rows[name].astype(np.float64) for name in _POSE], axis=-1))


def plan_hash(message: PointCloud2) -> str:
    """Return the identity of the plan whose `tool_path` this is: 16 hex digits of SHA-256.

    Of the stamp in nanoseconds as decimal digits, a space, the name of the frame, a line feed, and then the bytes of
    `data`: any planner can work it out from what it publishes.
    """
    digest = hashlib.sha256(f"{stamp_to_ns(message.header.stamp)} {message.header.frame_id}\n".encode())
    digest.update(message.data)
    return digest.hexdigest()[:16]
