"""A tool path as the arm receives it: where the laser focus goes, how fast, and where it fires."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ExecutionError
from octn_ros.simulation.pose import checked_poses

SLOWEST_M_S = 1e-6  # a millimetre in a quarter of an hour; a slower focus stands still with the shutter open


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
        hash: identity of the plan, as its planner states it too; without one nobody can stand for it.

    Raises:
        ExecutionError: the lengths differ, a pose is not rigid within 1e-6, or a speed is below a micrometre per
            second. A path without waypoints is one: it stands for no plan, and the arm refuses it.
    """

    waypoints_ee: NDArray[np.float64]
    segment: NDArray[np.int32]
    laser_on: NDArray[np.bool_]
    speed_m_s: NDArray[np.float64]
    stamp_ns: int
    frame: str
    hash: str = ""

    def __post_init__(self) -> None:
        count = len(self)
        object.__setattr__(self, "waypoints_ee", checked_poses("waypoints", self.waypoints_ee, (count,)))
        for name, dtype in (("segment", np.int32), ("laser_on", np.bool_), ("speed_m_s", np.float64)):
            array = np.array(getattr(self, name), dtype=dtype)
            if array.shape != (count,):
                raise ExecutionError(f"expected {name} for {count} waypoints, got shape {array.shape}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        forward = np.isfinite(self.speed_m_s) & (self.speed_m_s >= np.float32(SLOWEST_M_S))
        if not forward.all():
            first = int(np.argmin(forward))
            raise ExecutionError(
                f"expected speeds of at least {SLOWEST_M_S:g} m/s, got {self.speed_m_s[first]:g} at waypoint {first}"
            )

    def __len__(self) -> int:
        """Return the number of waypoints."""
        return len(self.waypoints_ee)
