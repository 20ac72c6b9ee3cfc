"""Rigid transforms as 4x4 matrices `A2B`, which map points of frame A into frame B, and their quaternions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from octn_ros.errors import CalibrationError

# Rounding of a matrix written with four digits stays below this; a mirrored or scaled one does not.
RIGID_TOLERANCE = 1e-3
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)


def make_rigid(matrix: Any) -> tuple[NDArray[np.float64], float]:
    """Return the rigid transform nearest to a matrix, and how far the matrix was from it.

    Args:
        matrix: 4x4 numbers, rotation upper left, translation in metres in the last column.

    Returns:
        The transform with an exactly orthonormal, right-handed rotation (float64), and the largest absolute
        difference of a rotation entry from the one given.

    Raises:
        CalibrationError: not 4x4 finite numbers, a last row other than 0 0 0 1, or a rotation further than 1e-3 from
            orthonormal (scaled, sheared, mirrored).
    """
    try:
        given = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"expected a transform of 4x4 numbers, got {matrix!r}") from None
    if given.shape != (4, 4):
        raise CalibrationError(f"expected a transform of 4x4 numbers, got an array of shape {given.shape}")
    if not np.isfinite(given).all():
        raise CalibrationError(f"expected finite numbers in the transform, got {given.tolist()}")
    if not np.allclose(given[3], _LAST_ROW, rtol=0.0, atol=1e-9):
        raise CalibrationError(
            f"expected 0 0 0 1 in the last row of the transform, got {given[3].tolist()}; is it transposed?"
        )
    # It is a rotation in any case: a mirrored matrix lies far from it and is refused below.
    rotation = nearest_rotation(given[:3, :3])
    deviation = float(np.max(np.abs(rotation - given[:3, :3])))
    if deviation > RIGID_TOLERANCE:
        raise CalibrationError(
            f"expected a rotation within {RIGID_TOLERANCE:g} of orthonormal and right-handed, got one {deviation:.3g} "
            f"from it (determinant {np.linalg.det(given[:3, :3]):.4g}); a mirrored scan axis belongs in the scan "
            "directions of the scanner, a scale in its spacing, never in the calibration"
        )
    return from_rotation(given[:3, 3], rotation), deviation


def nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation R [3, 3] nearest to a matrix C [3, 3], the one with the largest trace of R^T C.

    Of C = sum b a^T over matched vectors that is the rotation which turns a onto b with the least sum of squares.
    """
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right, dtype=np.float64)


def from_rotation(translation_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Put translation [3] in metres and rotation [3, 3] together; neither is checked."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation_m
    return transform


def from_translation_quaternion(translation_m: Any, quaternion_xyzw: Any) -> NDArray[np.float64]:
    """Return the 4x4 transform of a translation and a quaternion, which need not be of unit length.

    Args:
        translation_m: (x, y, z) in metres.
        quaternion_xyzw: (x, y, z, w), of length 1 within 1e-3.

    Raises:
        CalibrationError: they are not 3 + 4 finite numbers, or the quaternion is not of unit length.
    """
    try:
        translation = np.asarray(translation_m, dtype=np.float64)
        quaternion = np.asarray(quaternion_xyzw, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(
            f"expected 3 + 4 numbers of a pose, got {translation_m!r} and {quaternion_xyzw!r}"
        ) from None
    if translation.shape != (3,) or quaternion.shape != (4,):
        raise CalibrationError(f"expected 3 + 4 numbers of a pose, got {translation.shape} and {quaternion.shape}")
    length = float(np.linalg.norm(quaternion))
    if not np.isfinite(translation).all() or not abs(length - 1.0) <= RIGID_TOLERANCE:
        raise CalibrationError(
            "expected a finite translation and a quaternion (x, y, z, w) of unit length, "
            f"got {translation.tolist()} and {quaternion.tolist()} of length {length:.4g}"
        )
    return from_rotation(translation, Rotation.from_quat(quaternion / length).as_matrix())


def invert(a2b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return B2A [..., 4, 4] of rigid transforms A2B [..., 4, 4], by transposing the rotation."""
    b2a = np.zeros_like(a2b)
    rotation = np.swapaxes(a2b[..., :3, :3], -1, -2)
    b2a[..., :3, :3] = rotation
    b2a[..., :3, 3] = -(rotation @ a2b[..., :3, 3, None])[..., 0]
    b2a[..., 3, 3] = 1.0
    return b2a


def quaternions_xyzw(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions [N, (x, y, z, w)] of poses [N, 4, 4], continuous along the path.

    A quaternion and its negative are one rotation; each is given the sign nearer to its predecessor, the first one a
    w of at least 0, so that interpolation never takes the long way round.
    """
    if len(poses) == 0:
        return np.zeros((0, 4))
    quaternions = _quaternions(poses[:, :3, :3])
    flips = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0, -1.0, 1.0)
    first = -1.0 if quaternions[0, 3] < 0.0 else 1.0
    return np.asarray(quaternions * (first * np.cumprod(np.concatenate(([1.0], flips))))[:, None], dtype=np.float64)


def _quaternions(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a unit quaternion of each rotation [N, 3, 3], by its largest component as Shepperd does.

    SciPy makes matrices orthonormal first, which takes six times as long; poses are rigid already.
    """
    m = rotations
    trace = np.trace(m, axis1=1, axis2=2)
    largest = np.argmax(np.column_stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2], trace]), axis=1)
    quaternions = np.empty((len(m), 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        chosen = np.flatnonzero(largest == i)
        r = m[chosen]
        quaternions[chosen, i] = 1.0 - trace[chosen] + 2.0 * r[:, i, i]
        quaternions[chosen, j] = r[:, j, i] + r[:, i, j]
        quaternions[chosen, k] = r[:, k, i] + r[:, i, k]
        quaternions[chosen, 3] = r[:, k, j] - r[:, j, k]
    chosen = np.flatnonzero(largest == 3)
    r = m[chosen]
    quaternions[chosen, 0] = r[:, 2, 1] - r[:, 1, 2]
    quaternions[chosen, 1] = r[:, 0, 2] - r[:, 2, 0]
    quaternions[chosen, 2] = r[:, 1, 0] - r[:, 0, 1]
    quaternions[chosen, 3] = 1.0 + trace[chosen]
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
