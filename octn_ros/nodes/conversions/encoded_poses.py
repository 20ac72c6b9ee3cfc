"""Arrays of poses and paths straight from transforms to the bytes of their messages, as a publisher takes them.

A path of 10,000 poses is 40,000 Python objects, which take longer to make than the whole rest of a plan. What is only
published needs none of them: the encoding (CDR, little-endian, as every RMW of ROS 2 takes it) is written by NumPy.
Where the message itself is needed, as in a response, reading it from there takes less time than calling its classes.
"""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from octn_ros.nodes.conversions.headers import LITTLE_ENDIAN, encode_header
from octn_ros.planning import quaternions_xyzw

_POSE = 7  # float64: position (x, y, z), orientation (x, y, z, w)


def encode_pose_array(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> bytes:
    """Return the bytes of the PoseArray that `to_pose_array` makes of transforms [N, 4, 4]; N may be 0."""
    head = encode_header(stamp_ns, frame)
    head += bytes(-len(head) % 4) + len(poses).to_bytes(4, "little")
    if len(poses):
        head += bytes(-len(head) % 8)
    return LITTLE_ENDIAN + head + _numbers(poses).tobytes()


def encode_path(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> bytes:
    """Return the bytes of the Path that `to_path` makes of transforms [N, 4, 4]; N may be 0."""
    head = encode_header(stamp_ns, frame)
    head += bytes(-len(head) % 4) + len(poses).to_bytes(4, "little")
    if not len(poses):
        return LITTLE_ENDIAN + head
    # Only the first pose may begin off a multiple of 8; all others follow the doubles of the one before.
    first = encode_header(stamp_ns, frame)
    first += bytes(-(len(head) + len(first)) % 8)
    other = encode_header(stamp_ns, frame)
    other += bytes(-len(other) % 8)
    rows = np.empty(len(poses), np.dtype([("header", f"V{len(other)}"), ("pose", "<f8", _POSE)]))
    rows["header"] = np.void(other)
    rows["pose"] = _numbers(poses)
    return LITTLE_ENDIAN + head + first + rows.tobytes()[len(other) :]


def to_path(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> Path:
    """Return transforms [N, 4, 4] as a path in `frame`; N may be 0."""
    return deserialize_message(encode_path(poses, stamp_ns, frame), Path)


def _numbers(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(poses):
        return np.empty((0, _POSE))
    return np.column_stack([poses[:, :3, 3], quaternions_xyzw(poses)]).astype("<f8")
