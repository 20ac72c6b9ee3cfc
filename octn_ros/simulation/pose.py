"""Rigid poses as the simulated arm takes them, without the planner, which it must not depend on (nor on torch)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ExecutionError

# Poses come from quaternions or from a checked calibration, so they are exact; anything further off is a mistake.
_TOLERANCE = 1e-6


def checked_poses(name: str, matrices: Any, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
    """Return poses [*shape, 4, 4] as a read-only float64 copy.

    Args:
        name: what they are, for the error.
        matrices: the poses, translation in metres.
        shape: how many are expected.

    Raises:
        ExecutionError: another shape, not finite, or not rigid within 1e-6 (scaled, sheared, mirrored, transposed).
    """
    poses = np.array(matrices, dtype=np.float64)
    if poses.shape != (*shape, 4, 4):
        raise ExecutionError(f"{name}: expected poses of shape {(*shape, 4, 4)}, got {poses.shape}")
    finite = np.asarray(np.isfinite(poses).all(axis=(-2, -1)))
    rigid = np.where(finite[..., None, None], poses, 0.0)
    rotation = rigid[..., :3, :3]
    error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-2, -1))
    error += np.abs(rigid[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=-1)
    # A mirrored rotation is orthonormal too; only its determinant tells.
    wrong = np.atleast_1d((error > _TOLERANCE) | (np.linalg.det(rotation) <= 0.0) | ~finite)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise ExecutionError(
            f"{name}: expected finite rigid transforms (4x4, orthonormal right-handed rotation, last row 0 0 0 1), got "
            f"{int(wrong.sum())} others of {wrong.size}, the first at index {first}: "
            f"{poses.reshape(-1, 4, 4)[first].tolist()}"
        )
    poses.flags.writeable = False
    return poses


def inverse(a2b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose B2A [4, 4] of the rigid pose A2B [4, 4]."""
    b2a = np.eye(4)
    b2a[:3, :3] = a2b[:3, :3].T
    b2a[:3, 3] = -a2b[:3, :3].T @ a2b[:3, 3]
    return b2a
