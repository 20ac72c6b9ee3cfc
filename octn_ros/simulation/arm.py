"""A mock robot arm with a coaxial laser: it stages a plan, runs it only when told to, and remembers what it did."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ExecutionError
from octn_ros.settings import check_settings, setting
from octn_ros.simulation.laser_path import LaserPath
from octn_ros.simulation.pose import checked_poses, inverse
from octn_ros.simulation.trajectory import Trajectory

ArmState = Literal["idle", "staged", "executing", "done", "aborted"]

HISTORY_LENGTH = 20_000
"""Steps the arm remembers, the newest ones."""


@dataclass(frozen=True)
class ArmConfig:
    """Limits of the arm; the defaults suit a small collaborative arm."""

    reach_m: float = setting(0.85, "largest distance of the end effector from the base", unit="m", low=0.01, high=10.0)
    max_speed_m_s: float = setting(0.25, "largest speed of the end effector", unit="m/s", low=1e-4, high=10.0)
    control_period_s: float = setting(0.008, "time between two control steps", unit="s", low=1e-4, high=1.0)
    plan_max_age_s: float = setting(600.0, "age of the scan beyond which its plan is refused", unit="s", low=0.0)

    def __post_init__(self) -> None:
        check_settings(self)


class ArmSample(NamedTuple):
    """One remembered step: time in nanoseconds, pose of the end effector in the base, whether the laser was on."""

    time_ns: int
    ee2base: NDArray[np.float64]
    laser_on: bool


class Arm:
    """Simulated arm; not thread-safe: its owner calls it from one thread or under one lock.

    Each plan is executed once. After the last waypoint the arm returns to the pose of the scan, laser off, so that the
    next scan sees the tissue at the same place; after an abort it stays where it stopped.

    Args:
        config: its limits.
        laser2ee: maps points of the laser frame (focus at the origin, z along the beam) into the end-effector frame,
            4x4, metres.
        ee2base: pose of the end effector in the base frame at the start, 4x4, metres.
        ee_frame: name of the end-effector frame, in which paths are expected.

    Attributes:
        state: idle, staged, executing, done or aborted.
        ee2base: present pose of the end effector in the base frame.
        laser_on: whether the laser fired in the last step, or is on between two waypoints it fires at.
        history: the newest steps, oldest first.

    Raises:
        ExecutionError: a transform is not rigid.
    """

    def __init__(self, config: ArmConfig, laser2ee: Any, ee2base: Any, ee_frame: str = "tool0") -> None:
        self.config = config
        self.ee_frame = ee_frame
        self.state: ArmState = "idle"
        self.ee2base = checked_poses("ee2base", ee2base)
        self.laser_on = False
        self.history: deque[ArmSample] = deque(maxlen=HISTORY_LENGTH)
        self._laser2ee = checked_poses("laser2ee", laser2ee)
        self._ee2laser = inverse(self._laser2ee)
        self._path: LaserPath | None = None
        self._scan_ee2base = self.ee2base
        self._focus2base = np.zeros((0, 4, 4))
        self._trajectory = Trajectory(self.ee2base[None], np.zeros(1))
        self._start_ns = 0
        self._elapsed_s = 0.0
        self._passed = 0
        self._shots: list[NDArray[np.float64]] = []

    @property
    def executed(self) -> int:
        """Number of shots fired in the present or last execution."""
        return sum(len(shots) for shots in self._shots)

    @property
    def shots(self) -> NDArray[np.float64]:
        """Focus positions [M, 3] of the shots of the present or last execution, metres in the base frame."""
        return np.concatenate([np.zeros((0, 3)), *self._shots])

    @property
    def progress(self) -> tuple[int, int]:
        """Waypoints passed and waypoints in all of the staged, present or last plan."""
        return self._passed, len(self._focus2base)

    def stage(self, path: LaserPath, scan_stamp_ns: int, scan_ee2base: Any) -> None:
        """Take a plan to be executed later; nothing moves. Any plan staged before is dropped, upon refusal too.

        Args:
            path: the plan.
            scan_stamp_ns: time of the present scan.
            scan_ee2base: pose of the end effector in the base frame at that scan, 4x4, metres.

        Raises:
            ExecutionError: the plan is empty, in another frame, of another scan or out of reach, the pose is not
                rigid, or the arm is executing.
        """
        if self.state == "executing":
            raise ExecutionError("expected an arm at rest, got a plan while one is executing; abort first")
        self.withdraw()
        if len(path) == 0:
            raise ExecutionError("expected at least one waypoint, got an empty plan")
        if path.frame != self.ee_frame:
            raise ExecutionError(f"expected waypoints in frame {self.ee_frame!r}, got frame {path.frame!r}")
        if path.stamp_ns != scan_stamp_ns:
            raise ExecutionError(
                f"expected a plan of the present scan (stamp {scan_stamp_ns} ns), got one of another scan "
                f"(stamp {path.stamp_ns} ns); plan again on the present scan"
            )
        scan_pose = checked_poses("scan_ee2base", scan_ee2base)
        focus2base = scan_pose @ path.waypoints_ee
        distance_m = np.linalg.norm((focus2base @ self._ee2laser)[:, :3, 3], axis=1)
        farthest = int(np.argmax(distance_m))
        if distance_m[farthest] > self.config.reach_m:
            raise ExecutionError(
                f"expected end-effector positions within the reach of {self.config.reach_m:g} m, got "
                f"{distance_m[farthest]:.3f} m at waypoint {farthest} of {len(path)}"
            )
        self._path, self._scan_ee2base, self._focus2base = path, scan_pose, focus2base
        self._passed = 0
        self.state = "staged"

    def execute(self, now_ns: int) -> None:
        """Begin to run the staged plan; `step` then moves the arm.

        Args:
            now_ns: present time, nanoseconds, of the clock that stamped the scan.

        Raises:
            ExecutionError: nothing is staged, or the plan's scan is too old or lies in the future.
        """
        if self.state != "staged" or self._path is None:
            raise ExecutionError(f"expected a staged plan, got none (the arm is {self.state}); stage a plan first")
        age_s = (now_ns - self._path.stamp_ns) / 1e9
        if not 0.0 <= age_s <= self.config.plan_max_age_s:
            raise ExecutionError(
                f"expected a plan whose scan is 0 to {self.config.plan_max_age_s:g} s old, got one of {age_s:.1f} s; "
                "scan and plan again"
            )
        targets = np.concatenate([self.ee2base[None], self._focus2base @ self._ee2laser, self._scan_ee2base[None]])
        limit = self.config.max_speed_m_s
        # The way to the first waypoint and the way back carry no laser, so the arm's own limit is the only one.
        speeds = np.concatenate([[limit], np.minimum(self._path.speed_m_s[1:], limit), [limit]])
        self._trajectory = Trajectory.through(targets, (targets @ self._laser2ee)[:, :3, 3], speeds, limit)
        self._start_ns, self._elapsed_s, self._passed, self._shots = now_ns, 0.0, 0, []
        self.state = "executing"

    def step(self, dt_s: float | None = None) -> int:
        """Let time pass: move along the path and fire at every waypoint passed that has the laser on.

        Args:
            dt_s: seconds, the control period if none is given. Many waypoints may be passed in one step.

        Returns:
            Number of shots fired in this step. An arm that is not executing stays where it is.

        Raises:
            ExecutionError: the time is not a finite number of at least 0.
        """
        dt_s = self.config.control_period_s if dt_s is None else dt_s
        if not (math.isfinite(dt_s) and dt_s >= 0.0):
            raise ExecutionError(f"expected a step of at least 0 s, got {dt_s}")
        if self.state != "executing" or self._path is None:
            return 0
        self._elapsed_s = min(self._elapsed_s + dt_s, self._trajectory.duration_s)
        self.ee2base = self._trajectory.pose_at(self._elapsed_s)
        # The first pose of the trajectory is where the arm stood, the last one where it returns to.
        passed = min(self._trajectory.reached(self._elapsed_s) - 1, len(self._path))
        fired = self._path.laser_on[self._passed : passed]
        shots = self._focus2base[self._passed : passed, :3, 3][fired]
        if len(shots):
            self._shots.append(shots)
        self._passed = passed
        self.laser_on = len(shots) > 0 or self._beam_on(passed)
        self.history.append(ArmSample(self._start_ns + round(self._elapsed_s * 1e9), self.ee2base, self.laser_on))
        if self._elapsed_s >= self._trajectory.duration_s:
            self._stop("done")
        return len(shots)

    def abort(self) -> None:
        """Stop at once with the laser off and drop the plan; without a plan nothing changes."""
        if self.state in ("staged", "executing"):
            self._stop("aborted")

    def new_scan(self) -> None:
        """Tell the arm that a new scan begins: a staged plan is withdrawn, a running one aborted."""
        if self.state == "executing":
            self.abort()
        else:
            self.withdraw()

    def withdraw(self) -> None:
        """Drop a staged plan; a running one goes on."""
        if self.state == "staged":
            self._stop("idle")

    def _beam_on(self, passed: int) -> bool:
        """Whether the leg after the `passed`-th waypoint joins two waypoints of one segment that both fire."""
        assert self._path is not None
        if not 0 < passed < len(self._path):
            return False
        before, after = passed - 1, passed
        same_segment = bool(self._path.segment[before] == self._path.segment[after])
        return same_segment and bool(self._path.laser_on[before] and self._path.laser_on[after])

    def _stop(self, state: ArmState) -> None:
        if self.laser_on:
            self.laser_on = False
            self.history.append(ArmSample(self._start_ns + round(self._elapsed_s * 1e9), self.ee2base, False))
        self._path = None
        self.state = state
