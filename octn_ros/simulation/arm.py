"""A simulated robot arm with a coaxial laser: it stages a plan, runs it only when told to, and tells its shots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ExecutionError
from octn_ros.settings import setting
from octn_ros.simulation.laser_path import LaserPath
from octn_ros.simulation.pose import checked_poses, inverse
from octn_ros.simulation.shots import Shot, ShotSchedule, lone_waypoints
from octn_ros.simulation.trajectory import MotionLimits, Trajectory

ArmState = Literal["idle", "staged", "executing", "returning", "done", "aborted"]

HISTORY_LENGTH = 20_000
"""Steps the arm remembers, the newest ones."""


@dataclass(frozen=True)
class ArmConfig(MotionLimits):
    """Limits of the arm. Those of its joints are not modelled: the end effector's stand for them."""

    reach_m: float = setting(0.85, "largest distance of the end effector from the base", unit="m", low=0.01, high=10.0)
    control_period_s: float = setting(0.008, "time between two control steps", unit="s", low=1e-4, high=1.0)


class ArmSample(NamedTuple):
    """One remembered step: time in nanoseconds, pose of the end effector in the base, whether the laser was on."""

    time_ns: int
    ee2base: NDArray[np.float64]
    laser_on: bool


def _no_stray() -> NDArray[np.float64]:
    return np.eye(4)


class Arm:
    """Simulated arm; not thread-safe: its owner calls it from one thread or under one lock.

    Each plan is executed once, with speed and acceleration of the end effector limited, and the tool path's speed of
    the focus kept. After the last waypoint the arm returns to the pose of the scan, laser off, so that the next scan
    sees the tissue at the same place; after an abort it stays where it stopped until `go_to`.

    Args:
        config: its limits.
        laser2ee: maps points of the laser frame (focus at the origin, z along the beam) into the end-effector frame,
            4x4, metres.
        ee2base: pose of the end effector in the base frame at the start, 4x4, metres.
        ee_frame: name of the end-effector frame, in which paths are expected.
        stray: returns how far the end effector is off its commanded pose, 4x4 in its own frame, anew at each call;
            exact if left out.

    Attributes:
        state: idle, staged, executing, returning (to the pose of a scan), done or aborted.
        ee2base: present pose of the end effector in the base frame.
        commanded2base: where it would be without its stray.
        laser_on: whether the beam's shutter is open.
        shone: whether it was open at any time of the last step, which may be longer than a shot.
        path: the plan that is staged or being executed, None if there is none.
        history: the newest steps, oldest first.

    Raises:
        ExecutionError: a transform is not rigid.
    """

    def __init__(
        self,
        config: ArmConfig,
        laser2ee: Any,
        ee2base: Any,
        ee_frame: str = "tool0",
        stray: Callable[[], NDArray[np.float64]] = _no_stray,
    ) -> None:
        self.config = config
        self.ee_frame = ee_frame
        self.state: ArmState = "idle"
        self.ee2base = checked_poses("ee2base", ee2base)
        self.laser_on = self.shone = False
        self.history: deque[ArmSample] = deque(maxlen=HISTORY_LENGTH)
        self._laser2ee = checked_poses("laser2ee", laser2ee)
        self._ee2laser = inverse(self._laser2ee)
        self._stray = stray
        self.path: LaserPath | None = None
        self.commanded2base = self.ee2base
        self._scan_ee2base = self.ee2base
        self._focus2base = np.zeros((0, 4, 4))
        self._trajectory = self._motion(np.zeros((0, 4, 4)), np.zeros(0))
        self._schedule: ShotSchedule | None = None
        self._start_ns = 0
        self._elapsed_s = 0.0
        self._passed = 0
        self._fired = 0

    @property
    def executed(self) -> int:
        """Number of shots fired in the present or last execution."""
        return self._fired

    @property
    def elapsed_s(self) -> float:
        """Time since the present or last motion began, seconds of the arm's time."""
        return self._elapsed_s

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
                rigid, or the arm is moving.
        """
        if self.state in ("executing", "returning"):
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
        self.path, self._scan_ee2base, self._focus2base = path, scan_pose, focus2base
        self._passed = 0
        self.state = "staged"

    def execute(self, now_ns: int, dwell_s: float) -> None:
        """Begin to run the staged plan; `step` then moves the arm. Whether it may is for others to judge.

        Args:
            now_ns: present time, nanoseconds, of the clock that stamped the scan.
            dwell_s: length of the burst at each firing waypoint, seconds.

        Raises:
            ExecutionError: nothing is staged, or the plan cannot be followed.
        """
        if self.state != "staged" or self.path is None:
            raise ExecutionError(f"expected a staged plan, got none (the arm is {self.state}); stage a plan first")
        limit, path = self.config.max_speed_m_s, self.path
        targets = np.concatenate([self._focus2base, (self._scan_ee2base @ self._laser2ee)[None]])
        # The way to the first waypoint and the way back carry no laser, so the arm's own limit is the only one.
        speeds = np.concatenate([[limit], np.minimum(path.speed_m_s[1:], limit), [limit]])
        pauses = np.concatenate([[0.0], np.where(lone_waypoints(path), dwell_s, 0.0), [0.0]])
        self._trajectory = self._motion(targets, speeds, pauses)
        self._schedule = ShotSchedule.of(path, self._trajectory.times_s[1:-1], dwell_s)
        self._begin(now_ns, "executing")

    def go_to(self, ee2base: NDArray[np.float64], now_ns: int) -> float:
        """Begin to move to a pose in a straight line, laser off; return how long it will take, seconds.

        Raises:
            ExecutionError: the arm is moving.
        """
        if self.state in ("executing", "returning"):
            raise ExecutionError(f"expected an arm at rest, got one that is {self.state}; wait, or abort first")
        self.withdraw()
        self._trajectory = self._motion((ee2base @ self._laser2ee)[None], np.array([self.config.max_speed_m_s]))
        self._schedule = None
        self._begin(now_ns, "returning")
        return self._trajectory.duration_s

    def step(self, dt_s: float | None = None) -> list[Shot]:
        """Let time pass: move along the path and fire what is due on it.

        Args:
            dt_s: seconds, the control period if none is given. Many waypoints may be passed in one step.

        Returns:
            Shots that ended in this step. An arm that is not moving stays where it is.

        Raises:
            ExecutionError: the time is not a finite number of at least 0.
        """
        dt_s = self.config.control_period_s if dt_s is None else dt_s
        if not (math.isfinite(dt_s) and dt_s >= 0.0):
            raise ExecutionError(f"expected a step of at least 0 s, got {dt_s}")
        if self.state not in ("executing", "returning"):
            return []
        before_s = self._elapsed_s
        self._elapsed_s = min(self._elapsed_s + dt_s, self._trajectory.duration_s)
        self.commanded2base = self._trajectory.focus_at(self._elapsed_s) @ self._ee2laser
        self.ee2base = self.commanded2base @ self._stray()
        # The first pose of the trajectory is where the arm stood, the last one where it goes to in the end.
        self._passed = min(self._trajectory.reached(self._elapsed_s) - 1, len(self._focus2base))
        ended: list[Shot] = []
        if self._schedule is not None:
            due = int(np.searchsorted(self._schedule.end_s, self._elapsed_s, side="right"))
            ended = self._shots(self._schedule, due, self._schedule.end_s)
            self.laser_on = self._schedule.open_at(self._elapsed_s)
            self.shone = self._schedule.open_within(before_s, self._elapsed_s)
        self._remember()
        if self._elapsed_s >= self._trajectory.duration_s:
            self._stop("done" if self.state == "executing" else "idle")
        return ended

    def abort(self) -> list[Shot]:
        """Stop at once with the laser off and drop the plan; without a plan nothing changes.

        Returns:
            The shot that was cut short, if there was one.
        """
        schedule = self._schedule if self.state == "executing" else None
        # First of all: whatever may go wrong below, the laser is off.
        if self.state in ("staged", "executing", "returning"):
            self._stop("aborted")
        if schedule is None:
            return []
        begun = int(np.searchsorted(schedule.start_s, self._elapsed_s, side="left"))
        return self._shots(schedule, begun, np.minimum(schedule.end_s, self._elapsed_s))

    def withdraw(self) -> None:
        """Drop a staged plan; a running one goes on."""
        if self.state == "staged":
            self._stop("idle")

    def _motion(
        self, targets: NDArray[np.float64], speeds: NDArray[np.float64], pauses: NDArray[np.float64] | None = None
    ) -> Trajectory:
        """Return the motion of the focus from where it is through targets [M, 4, 4], speeds [M], pauses [M + 1]."""
        places = np.concatenate([(self.commanded2base @ self._laser2ee)[None], targets])
        return Trajectory(places, speeds, self._ee2laser, self.config, pauses)

    def _begin(self, now_ns: int, state: ArmState) -> None:
        self._start_ns, self._elapsed_s, self._passed, self._fired = now_ns, 0.0, 0, 0
        self.state = state

    def _shots(self, schedule: ShotSchedule, last: int, end_s: NDArray[np.float64]) -> list[Shot]:
        """Fire the next shots of the schedule up to `last`, which is left out, until these times at most."""
        first = self._fired
        if last <= first:
            return []
        start, end = schedule.start_s[first:last], end_s[first:last]
        commanded = self._trajectory.focus_at(0.5 * (start + end)) @ self._ee2laser
        shots = []
        for index, begun_s, ended_s, tool in zip(schedule.waypoint[first:last], start, end, commanded, strict=True):
            focus = tool @ self._stray() @ self._laser2ee
            dwell_s = float(ended_s - begun_s)
            shots.append(Shot(int(index), float(begun_s), dwell_s, self._focus2base[index], focus))
        self._fired = last
        return shots

    def _remember(self) -> None:
        self.history.append(ArmSample(self._start_ns + round(self._elapsed_s * 1e9), self.ee2base, self.laser_on))

    def _stop(self, state: ArmState) -> None:
        self.shone = False
        if self.laser_on:
            self.laser_on = False
            self._remember()
        self.path = self._schedule = None
        self.state = state
