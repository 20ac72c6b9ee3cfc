"""A tool path as the arm receives it: where the laser focus goes, how fast, and where it fires."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ExecutionError
from octn_ros.planning.transforms import RIGID_TOLERANCE


@dataclass(frozen=True, eq=False)
class LaserPath:
    """Waypoints of the laser focus; immutable and thread-safe.

    Attributes:
        waypoints_ee: poses of the focus, z along the beam, in the end-effector frame of the scan's time [N, 4, 4].
        segment: which stretch of the raster each waypoint belongs to [N], integers.
        laser_on: whether a shot is fired at each waypoint [N].
        speed_m_s: speed of the focus on the way to each waypoint [N], metres per second.
        stamp_ns: time of the scan it was planned on, nanoseconds.
        frame: name of the frame of `waypoints_ee`.

    Raises:
        ExecutionError: the lengths differ, a pose is not rigid within 1e-3, or a speed is not positive. A path
            without waypoints is one: it stands for no plan, and the arm refuses it.
    """

    waypoints_ee: NDArray[np.float64]
    segment: NDArray[np.int32]
    laser_on: NDArray[np.bool_]
    speed_m_s: NDArray[np.float64]
    stamp_ns: int
    frame: str

    def __post_init__(self) -> None:
        self._keep("waypoints_ee", np.float64)
        self._keep("segment", np.int32)
        self._keep("laser_on", np.bool_)
        self._keep("speed_m_s", np.float64)
        count = len(self)
        if self.waypoints_ee.shape != (count, 4, 4):
            raise ExecutionError(f"expected waypoints of shape [N, 4, 4], got {self.waypoints_ee.shape}")
        for name in ("segment", "laser_on", "speed_m_s"):
            if getattr(self, name).shape != (count,):
                raise ExecutionError(f"expected {name} for {count} waypoints, got shape {getattr(self, name).shape}")
        finite = np.isfinite(self.waypoints_ee).all(axis=(1, 2))
        self._refuse(~finite, "finite poses", self.waypoints_ee)
        rotation = self.waypoints_ee[:, :3, :3]
        error = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2), initial=0.0)
        error += np.abs(self.waypoints_ee[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1, initial=0.0)
        # A mirrored rotation is orthonormal too; only its determinant tells.
        rigid = (error <= RIGID_TOLERANCE) & (np.linalg.det(rotation) > 0.0)
        self._refuse(~rigid, "rigid poses", self.waypoints_ee)
        forward = np.isfinite(self.speed_m_s) & (self.speed_m_s > 0.0)
        self._refuse(~forward, "speeds above 0 m/s", self.speed_m_s)

    def __len__(self) -> int:
        """Return the number of waypoints."""
        return len(self.waypoints_ee)

    def _keep(self, name: str, dtype: Any) -> None:
        array = np.array(getattr(self, name), dtype=dtype)
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    @staticmethod
    def _refuse(bad: Any, expected: str, values: NDArray[np.float64]) -> None:
        if bad.any():
            first = int(np.argmax(bad))
            raise ExecutionError(
                f"expected {expected}, got {int(bad.sum())} of {len(bad)} others, the first at waypoint {first}: "
                f"{values[first].tolist()}"
            )
