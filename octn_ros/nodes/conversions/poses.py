"""Poses, arrays of poses and paths to 4x4 transforms and back; quaternions are (x, y, z, w)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseArray, PoseStamped, Quaternion
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from octn_ros.errors import ExecutionError
from octn_ros.nodes.conversions.headers import header
from octn_ros.planning import from_translation_quaternion, quaternions_xyzw


def pose_to_matrix(pose: Pose) -> NDArray[np.float64]:
    """Return a pose as the 4x4 transform that maps its own frame into that of its header.

    Raises:
        CalibrationError: a coordinate is not finite, or the quaternion is not of unit length within 1e-3.
    """
    place, turn = pose.position, pose.orientation
    return from_translation_quaternion((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def matrix_to_pose_stamped(a2b: NDArray[np.float64], stamp_ns: int, frame: str) -> PoseStamped:
    """Return the pose of frame A in frame B, whose name `frame` is."""
    return PoseStamped(header=header(stamp_ns, frame), pose=_poses(a2b[None])[0])


def to_pose_array(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> PoseArray:
    """Return transforms [N, 4, 4] as poses in `frame`; N may be 0."""
    return PoseArray(header=header(stamp_ns, frame), poses=_poses(poses))


def poses_to_matrices(poses: Sequence[Pose]) -> NDArray[np.float64]:
    """Return the poses of a PoseArray as transforms [N, 4, 4].

    Raises:
        ExecutionError: a coordinate is not finite, or a quaternion not of unit length within 1e-3.
    """
    rows = [
        (p.position.x, p.position.y, p.position.z, p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w)
        for p in poses
    ]
    return rigid_transforms(np.array(rows, dtype=np.float64).reshape(-1, 7))


def rigid_transforms(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions and quaternions [N, (x, y, z, qx, qy, qz, qw)] as transforms [N, 4, 4].

    Raises:
        ExecutionError: a coordinate is not finite, or a quaternion not of unit length within 1e-3.
    """
    # NaN fails this comparison too.
    good = np.isfinite(numbers).all(axis=1) & (np.abs(np.linalg.norm(numbers[:, 3:], axis=1) - 1.0) <= 1e-3)
    if not good.all():
        first = int(np.argmin(good))
        raise ExecutionError(
            f"expected finite poses with unit quaternions, got {np.count_nonzero(~good)} of {len(good)} others, "
            f"the first at {first}: {numbers[first].tolist()}"
        )
    matrices = np.tile(np.eye(4), (len(numbers), 1, 1))
    matrices[:, :3, 3] = numbers[:, :3]
    if len(numbers):
        matrices[:, :3, :3] = Rotation.from_quat(numbers[:, 3:]).as_matrix()
    return matrices


def _poses(poses: NDArray[np.float64]) -> list[Pose]:
    if not len(poses):
        return []
    places, turns = poses[:, :3, 3].tolist(), quaternions_xyzw(poses).tolist()
    return [
        Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(places, turns, strict=True)
    ]
