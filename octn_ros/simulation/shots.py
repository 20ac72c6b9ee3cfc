"""Shots of the laser: when they are due on a path, and what became of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.simulation.laser_path import LaserPath


@dataclass(frozen=True, eq=False)
class Shot:
    """One burst of the laser, fired; read-only.

    Attributes:
        waypoint: index of its waypoint in the plan.
        start_s: when it began, seconds of the arm's time since the execution began.
        dwell_s: how long it lasted.
        planned2base: the waypoint in the base frame [4, 4], as the plan has it.
        focus2base: the focus at the middle of the burst in the base frame [4, 4], where the arm really was.
    """

    waypoint: int
    start_s: float
    dwell_s: float
    planned2base: NDArray[np.float64]
    focus2base: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShotSchedule:
    """When the laser is on along a path; read-only.

    Attributes:
        waypoint: index of the waypoint of each shot [S], rising.
        start_s: beginning of each shot [S].
        end_s: end of each shot [S], never after the next one's beginning.
        gate_s: beginning and end [G, 2] of each stretch of firing waypoints: the beam's shutter is open there only.
    """

    waypoint: NDArray[np.intp]
    start_s: NDArray[np.float64]
    end_s: NDArray[np.float64]
    gate_s: NDArray[np.float64]

    @classmethod
    def of(cls, path: LaserPath, reached_s: NDArray[np.float64], dwell_s: float) -> ShotSchedule:
        """Return the shots of a path whose waypoints are reached at these times [N].

        A shot lies evenly about its waypoint's time, but within the stretch of firing waypoints of one segment that the
        waypoint belongs to, so that nothing is fired on turns and over given-up stretches, and no nearer in time to
        another waypoint: a longer burst is cut there. A waypoint alone in its stretch is fired at from its time on: the
        arm halts there.
        """
        stretch = stretches(path)
        waypoint = np.flatnonzero(path.laser_on)
        number, at_s = stretch[waypoint], reached_s[waypoint]
        begins, ends = np.diff(number, prepend=-1) != 0, np.diff(number, append=-1) != 0
        between = 0.5 * (at_s[1:] + at_s[:-1])
        earliest = np.where(begins, at_s, np.concatenate((at_s[:1], between)))
        latest = np.where(ends, at_s, np.concatenate((between, at_s[-1:])))
        latest = np.where(begins & ends, at_s + dwell_s, latest)
        start = np.maximum(np.minimum(at_s - 0.5 * dwell_s, latest - dwell_s), earliest)
        end = np.minimum(start + dwell_s, latest)
        return cls(waypoint, start, end, np.stack([at_s[begins], latest[ends]], axis=1))

    def open_at(self, time_s: float) -> bool:
        """Whether the beam's shutter is open."""
        return self.open_within(time_s, time_s)

    def open_within(self, begin_s: float, end_s: float) -> bool:
        """Whether the beam's shutter is open at any time from `begin_s` to `end_s`."""
        stretch = int(np.searchsorted(self.gate_s[:, 0], end_s, side="right")) - 1
        return stretch >= 0 and begin_s < float(self.gate_s[stretch, 1])


def stretches(path: LaserPath) -> NDArray[np.intp]:
    """Return the number of the run of firing waypoints of one segment that each waypoint belongs to, from 0 [N]."""
    changes = (np.diff(path.segment) != 0) | (np.diff(path.laser_on.astype(np.int8)) != 0)
    return np.concatenate(([0], np.cumsum(changes)))


def lone_waypoints(path: LaserPath) -> NDArray[np.bool_]:
    """Return which waypoints fire alone in their stretch [N]."""
    stretch = stretches(path)
    return np.asarray((np.bincount(stretch)[stretch] == 1) & path.laser_on)
