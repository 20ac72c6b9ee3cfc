"""The probe on the robot's hand, from a fixed fiducial that it sees from several poses of the arm (AX = XB)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from octn_ros.errors import CalibrationError
from octn_ros.planning.transforms import from_rotation, invert, nearest_rotation

# Turns between the poses of the arm, RMS about the second most used axis, below which an axis is not seen.
LEAST_TURN_RAD = math.radians(2.0)
# Spread of a fiducial point in the scan, RMS in the second direction, below which the probe's turn is not seen.
LEAST_SPREAD_M = 50e-6
# Length over which an error of the fiducial's orientation counts against one of its position.
LEVER_M = 10e-3

# Of oct2ee [4, 4] and the fiducial [3 or 6]: what is left at each pose [N, 3 or 6], in metres.
_Misses = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class HandEyeFit:
    """Where the probe sits on the end effector, and how well all poses agree on it; read-only.

    Attributes:
        oct2ee: maps points of the OCT frame into the end-effector frame, 4x4, metres.
        fiducial_m: place of the fiducial in the base frame [3], one for all poses.
        residual_m: how far the fiducial lies from there by each pose of the arm [N].
        residual_rad: how far its orientation is from the common one [N]; None for a fiducial without orientation.
        translation_std_m: standard deviation of the translation of `oct2ee`, from the residuals, largest direction.
        rotation_std_rad: of its rotation, about the least certain axis.
    """

    oct2ee: NDArray[np.float64]
    fiducial_m: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    residual_rad: NDArray[np.float64] | None
    translation_std_m: float
    rotation_std_rad: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residual_m**2)))


def hand_eye_from_points(ee2base: NDArray[np.float64], points_oct: NDArray[np.float64]) -> HandEyeFit:
    """Calibrate with a fixed fiducial that is a point: ee2base_i oct2ee p_i is the same place for all poses i.

    A linear solution in the directions in which the point moves through the scan, turned into the nearest rotation,
    then non-linear least squares. The probe's orientation is seen only by the point's moves within the scan, so let it
    wander through the whole field of view.

    Args:
        ee2base: poses of the arm [N, 4, 4], rigid.
        points_oct: where the probe saw the point (x, y, z) [N, 3], in metres.

    Raises:
        CalibrationError: fewer than 4 poses, turns about fewer than two axes, or a point that stayed in one place or
            on one line of the scan.
    """
    poses, points = _checked(ee2base, 4), np.asarray(points_oct, dtype=np.float64)
    if points.shape != (len(poses), 3) or not np.isfinite(points).all():
        raise CalibrationError(f"expected a finite fiducial point for each of {len(poses)} poses, got {points.shape}")
    middle = points.mean(axis=0)
    _, sizes, directions = np.linalg.svd(points - middle, full_matrices=True)
    spread = sizes / math.sqrt(len(points))
    if spread[1] < LEAST_SPREAD_M:
        raise CalibrationError(
            f"expected a fiducial point that moves by {LEAST_SPREAD_M * 1e6:.0f} um or more along two directions of "
            f"the scan, got {spread[0] * 1e6:.1f} and {spread[1] * 1e6:.1f} um; show it in all corners of the scan"
        )
    # Unknown: oct2ee of the middle, of each direction in which the point moves, and the fiducial in the base frame.
    seen = int((spread > max(LEAST_SPREAD_M, 1e-3 * spread[0])).sum())
    along = (points - middle) @ directions[:seen].T
    turns, shifts = poses[:, :3, :3], poses[:, :3, 3]
    blocks = [turns, *(turns * (along[:, k] / spread[k])[:, None, None] for k in range(seen))]
    system = np.concatenate([*blocks, np.broadcast_to(-np.eye(3), turns.shape)], axis=2).reshape(-1, 3 * (seen + 2))
    solution = np.linalg.lstsq(system, -shifts.reshape(-1), rcond=None)[0].reshape(-1, 3)
    images = solution[1 : 1 + seen] / spread[:seen, None]
    rotation = nearest_rotation(images.T @ directions[:seen])
    start = from_rotation(solution[0] - rotation @ middle, rotation)

    def misses(oct2ee: NDArray[np.float64], fiducial: NDArray[np.float64]) -> NDArray[np.float64]:
        mapped = points @ oct2ee[:3, :3].T + oct2ee[:3, 3]
        return np.asarray(np.einsum("nij,nj->ni", turns, mapped) + shifts - fiducial[:3], dtype=np.float64)

    return _refined(start, solution[-1], misses, oriented=False)


def hand_eye_from_poses(ee2base: NDArray[np.float64], fiducial2oct: NDArray[np.float64]) -> HandEyeFit:
    """Calibrate with a fixed fiducial whose pose the probe sees: ee2base_i oct2ee fiducial2oct_i is the same (AX = XB).

    Park and Martin's closed form for the rotation, a linear one for the translation, then non-linear least squares in
    which orientation counts over a lever of 10 mm.

    Args:
        ee2base: poses of the arm [N, 4, 4], rigid.
        fiducial2oct: pose of the fiducial in the OCT frame at each [N, 4, 4], rigid.

    Raises:
        CalibrationError: fewer than 3 poses, or turns about fewer than two axes.
    """
    poses, seen = _checked(ee2base, 3), np.asarray(fiducial2oct, dtype=np.float64)
    if seen.shape != poses.shape or not np.isfinite(seen).all():
        raise CalibrationError(f"expected a finite fiducial pose for each of {len(poses)} poses, got {seen.shape}")
    # All pairs: A = ee_j2ee_i moves the hand, B = what the probe saw of it, and A X = X B.
    first, second = np.triu_indices(len(poses), 1)
    hand = invert(poses[first]) @ poses[second]
    eye = seen[first] @ invert(seen[second])
    rotation = nearest_rotation(_turns(hand).T @ _turns(eye))
    system = (hand[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    wanted = (eye[:, :3, 3] @ rotation.T - hand[:, :3, 3]).reshape(-1)
    start = from_rotation(np.linalg.lstsq(system, wanted, rcond=None)[0], rotation)
    common = poses @ start @ seen
    middle = Rotation.from_matrix(common[:, :3, :3]).mean()

    def misses(oct2ee: NDArray[np.float64], fiducial: NDArray[np.float64]) -> NDArray[np.float64]:
        found = poses @ oct2ee @ seen
        turned = Rotation.from_rotvec(fiducial[3:]).inv() * Rotation.from_matrix(found[:, :3, :3])
        return np.hstack([found[:, :3, 3] - fiducial[:3], LEVER_M * turned.as_rotvec()])

    fiducial = np.concatenate([common[:, :3, 3].mean(axis=0), middle.as_rotvec()])
    return _refined(start, fiducial, misses, oriented=True)


def _refined(
    start: NDArray[np.float64], fiducial: NDArray[np.float64], misses: _Misses, *, oriented: bool
) -> HandEyeFit:
    """Least squares over a small turn (in 1/LEVER_M, so that all unknowns are metres) and shift of `start`."""

    def moved(unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        turn = Rotation.from_rotvec(unknowns[:3] / LEVER_M).as_matrix()
        return from_rotation(start[:3, 3] + unknowns[3:6], turn @ start[:3, :3])

    def fiducial_of(unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        return fiducial + unknowns[6:] / np.repeat([1.0, LEVER_M], [3, len(fiducial) - 3])

    result = least_squares(
        lambda unknowns: misses(moved(unknowns), fiducial_of(unknowns)).ravel(),
        np.zeros(6 + len(fiducial)),
        method="lm",
        x_scale=1e-3,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    left = misses(moved(result.x), fiducial_of(result.x))
    freedom = left.size - len(result.x)
    variance = float(np.sum(left**2)) / freedom if freedom > 0 else math.nan
    covariance = variance * np.linalg.pinv(result.jac.T @ result.jac)
    return HandEyeFit(
        oct2ee=moved(result.x),
        fiducial_m=fiducial_of(result.x)[:3],
        residual_m=np.linalg.norm(left[:, :3], axis=1),
        residual_rad=np.linalg.norm(left[:, 3:], axis=1) / LEVER_M if oriented else None,
        translation_std_m=_largest_std(covariance[3:6, 3:6]),
        rotation_std_rad=_largest_std(covariance[:3, :3]) / LEVER_M,
    )


def _largest_std(covariance: NDArray[np.float64]) -> float:
    if not np.isfinite(covariance).all():
        return math.nan
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))


def _turns(transforms: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_matrix(transforms[:, :3, :3]).as_rotvec(), dtype=np.float64)


def _checked(ee2base: NDArray[np.float64], least: int) -> NDArray[np.float64]:
    """Return the poses of the arm if they turn enough for a calibration."""
    poses = np.asarray(ee2base, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
        raise CalibrationError(f"expected finite poses of the arm [N, 4, 4], got {poses.shape}")
    if len(poses) < least:
        raise CalibrationError(f"expected at least {least} poses of the arm, got {len(poses)}")
    turns = _turns(invert(poses[0]) @ poses)
    about = np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False) / math.sqrt(len(poses))
    if about[1] < LEAST_TURN_RAD:
        raise CalibrationError(
            f"expected poses of the arm that turn by {math.degrees(LEAST_TURN_RAD):g} degrees or more (RMS) about two "
            f"axes, got {math.degrees(about[0]):.2f} and {math.degrees(about[1]):.2f} degrees; tilt the hand about "
            "another axis too, or the translation along the common one stays open"
        )
    return poses
