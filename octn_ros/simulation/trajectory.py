"""A timed motion of the end effector through given poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses and the times at which they are reached; immutable and thread-safe.

    Between poses the position moves on a straight line and the orientation on the shortest arc, both evenly.

    Attributes:
        poses: end effector in the base frame [M, 4, 4], metres, M >= 1.
        times_s: when each is reached [M], seconds from the start, never falling, the first 0.
    """

    poses: NDArray[np.float64]
    times_s: NDArray[np.float64]

    @classmethod
    def through(
        cls,
        poses: NDArray[np.float64],
        focus_m: NDArray[np.float64],
        focus_speed_m_s: NDArray[np.float64],
        max_speed_m_s: float,
    ) -> Trajectory:
        """Time a motion so that neither the laser focus nor the end effector is faster than allowed.

        Args:
            poses: end effector in the base frame [M, 4, 4].
            focus_m: laser focus at each pose [M, 3], metres in the base frame.
            focus_speed_m_s: largest speed of the focus on each leg [M - 1].
            max_speed_m_s: largest speed of the end effector's origin.
        """
        focus_leg_m = np.linalg.norm(np.diff(focus_m, axis=0), axis=1)
        tool_leg_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        legs_s = np.maximum(focus_leg_m / focus_speed_m_s, tool_leg_m / max_speed_m_s)
        return cls(poses, np.concatenate(([0.0], np.cumsum(legs_s))))

    @property
    def duration_s(self) -> float:
        """Time of the last pose, seconds."""
        return float(self.times_s[-1])

    def reached(self, time_s: float) -> int:
        """Return the number of poses reached by `time_s`, the first one included."""
        return int(np.searchsorted(self.times_s, time_s, side="right"))

    def pose_at(self, time_s: float) -> NDArray[np.float64]:
        """Return the pose 4x4 at `time_s` seconds; before the start and after the end the arm rests."""
        after = self.reached(time_s)
        if after in (0, len(self.times_s)):
            return self.poses[max(after - 1, 0)].copy()
        start, end = self.times_s[after - 1], self.times_s[after]
        share = (time_s - start) / (end - start)
        leg = self.poses[after - 1 : after + 1]
        pose = np.eye(4)
        pose[:3, 3] = (1.0 - share) * leg[0, :3, 3] + share * leg[1, :3, 3]
        pose[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix(leg[:, :3, :3]))(share).as_matrix()
        return pose
