"""How far the simulated machines are from what they are taken for."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class InaccuracyConfig:
    """Errors of the platform; all are drawn from one seed."""

    calibration_error_m: float = setting(
        0.0, "distance of the true oct2ee from that of the calibration file, in a random direction", unit="m",
        low=0.0, high=0.01,
    )  # fmt: skip
    calibration_error_deg: float = setting(
        0.0, "angle between the two, about a random axis through the OCT frame's origin", unit="deg", low=0.0, high=30.0
    )
    pose_noise_m: float = setting(
        0.0, "standard deviation along each axis of the end effector about its commanded place", unit="m",
        low=0.0, high=0.01,
    )  # fmt: skip
    pose_noise_deg: float = setting(
        0.0, "standard deviation about each axis of its orientation", unit="deg", low=0.0, high=10.0
    )
    seed: int = setting(0, "seed of the directions and of the noise", low=0)

    def __post_init__(self) -> None:
        check_settings(self)


class Inaccuracy:
    """Errors drawn once, and noise drawn at each call; safe from any thread.

    The noise is white: two calls are independent of each other, however close in time.

    Attributes:
        oct2oct: the true OCT frame in the one that the calibration file makes of it, 4x4.
    """

    def __init__(self, config: InaccuracyConfig) -> None:
        fixed = np.random.default_rng((config.seed, 0))
        self._generator = np.random.default_rng((config.seed, 1))
        self._lock = threading.Lock()
        self._spread_m, self._spread_rad = config.pose_noise_m, np.radians(config.pose_noise_deg)
        shift, turn = (direction / np.linalg.norm(direction) for direction in fixed.normal(size=(2, 3)))
        turn *= np.radians(config.calibration_error_deg)
        self.oct2oct = _pose(config.calibration_error_m * shift, turn)

    def stray(self) -> NDArray[np.float64]:
        """Return the end effector's pose [4, 4] in the frame in which it was commanded to be."""
        if not (self._spread_m or self._spread_rad):
            return np.eye(4)
        with self._lock:
            shift, turn = self._generator.normal(size=(2, 3))
        return _pose(self._spread_m * shift, self._spread_rad * turn)


def _pose(shift_m: NDArray[np.float64], turn_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn_rad).as_matrix(), shift_m
    return pose
