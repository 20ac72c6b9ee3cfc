"""Arrays of poses and paths straight from transforms to the bytes of their messages, as a publisher takes them.

A path of 10,000 poses is 40,000 Python objects, which take longer to make than the whole rest of a plan. What is only
published needs none of them: the encoding (CDR, little-endian, as every RMW of ROS 2 takes it) is written by NumPy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from octn_ros.planning import quaternions_xyzw

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # of plain CDR; places in the encoding are counted from behind it
_POSE = 7  # float64: position (x, y, z), orientation (x, y, z, w)


def encode_pose_array(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> bytes:
    """Return the bytes of the PoseArray that `to_pose_array` makes of transforms [N, 4, 4]; N may be 0."""
    head = _header(stamp_ns, frame)
    head += bytes(-len(head) % 4) + len(poses).to_bytes(4, "little")
    if len(poses):
        head += bytes(-len(head) % 8)
    return _LITTLE_ENDIAN + head + _numbers(poses).tobytes()


def encode_path(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> bytes:
    """Return the bytes of the Path that `to_path` makes of transforms [N, 4, 4]; N may be 0."""
    head = _header(stamp_ns, frame)
    head += bytes(-len(head) % 4) + len(poses).to_bytes(4, "little")
    if not len(poses):
        return _LITTLE_ENDIAN + head
    # Only the first pose may begin off a multiple of 8; all others follow the doubles of the one before.
    first = _header(stamp_ns, frame)
    first += bytes(-(len(head) + len(first)) % 8)
    other = _header(stamp_ns, frame)
    other += bytes(-len(other) % 8)
    rows = np.empty(len(poses), np.dtype([("header", f"V{len(other)}"), ("pose", "<f8", _POSE)]))
    rows["header"] = np.void(other)
    rows["pose"] = _numbers(poses)
    return _LITTLE_ENDIAN + head + first + rows.tobytes()[len(other) :]


def _header(stamp_ns: int, frame: str) -> bytes:
    """Return the encoding of a Header, which begins at a multiple of 4."""
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    name = frame.encode() + b"\0"
    return (
        seconds.to_bytes(4, "little", signed=True)
        + nanoseconds.to_bytes(4, "little")
        + len(name).to_bytes(4, "little")
        + name
    )


def _numbers(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(poses):
        return np.empty((0, _POSE))
    return np.column_stack([poses[:, :3, 3], quaternions_xyzw(poses)]).astype("<f8")
