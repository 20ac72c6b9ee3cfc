"""Where the end effector was: its recent poses, looked up by time, and how far it moved meanwhile."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import dataclass
from itertools import islice
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

KEPT_NS = 120_000_000_000  # longer than any C-scan takes to arrive
MOST = 120_000  # poses: an arm that tells a thousand a second is remembered for that long, in some 50 MB
SET_BACK_NS = 1_000_000_000  # a stamp that lies further before the newest one is of a clock that was set back
_STAMP = attrgetter("stamp_ns")


@dataclass(frozen=True, eq=False, slots=True)
class StampedPose:
    """A pose of the end effector.

    Attributes:
        stamp_ns: when it was taken.
        ee2base: the pose [4, 4].
        frame: name of the base frame.
    """

    stamp_ns: int
    ee2base: NDArray[np.float64]
    frame: str


@dataclass(frozen=True)
class Motion:
    """How far the end effector was away from a pose, at most.

    Attributes:
        translation_m: largest distance from the place of that pose.
        rotation_rad: largest angle from its orientation.
    """

    translation_m: float
    rotation_rad: float


class PoseHistory:
    """The poses of the last 120 s, 120,000 at most, in the order of their stamps; safe from any thread."""

    def __init__(self) -> None:
        self._poses: deque[StampedPose] = deque()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return how many poses are kept."""
        return len(self._poses)

    def add(self, pose: StampedPose) -> float:
        """Keep a pose, which may come a little after later ones.

        Returns:
            By how many seconds the clock of the poses was set back, so that all before this one are forgotten; else 0.
        """
        with self._lock:
            back_ns = self._poses[-1].stamp_ns - pose.stamp_ns if self._poses else 0
            if back_ns > SET_BACK_NS:
                self._poses.clear()
            insort(self._poses, pose, key=_STAMP)
            oldest_ns = self._poses[-1].stamp_ns - KEPT_NS
            while len(self._poses) > MOST or self._poses[0].stamp_ns < oldest_ns:
                self._poses.popleft()
        return back_ns * 1e-9 if back_ns > SET_BACK_NS else 0.0

    def nearest(self, stamp_ns: int, largest_gap_s: float) -> StampedPose | None:
        """Return the pose nearest in time, None if there is none within `largest_gap_s`."""
        with self._lock:
            after = bisect_left(self._poses, stamp_ns, key=_STAMP)
            around = list(islice(self._poses, max(after - 1, 0), after + 1))
        found = min(around, key=lambda kept: abs(kept.stamp_ns - stamp_ns), default=None)
        if found is None or abs(found.stamp_ns - stamp_ns) > largest_gap_s * 1e9:
            return None
        return found

    def heard_until(self, stamp_ns: int) -> bool:
        """Return whether a pose of this time or later has come."""
        with self._lock:
            return bool(self._poses) and self._poses[-1].stamp_ns >= stamp_ns

    def motion(self, start_ns: int, end_ns: int, largest_gap_s: float) -> Motion | None:
        """Return how far the end effector moved in a stretch of time from where it was at its start.

        Where fewer than two poses were taken in the stretch, the first one after it counts too.

        Returns:
            None if no pose was taken within `largest_gap_s` of the start, so that nobody knows.
        """
        start = self.nearest(start_ns, largest_gap_s)
        if start is None:
            return None
        with self._lock:
            first = bisect_left(self._poses, start_ns, key=_STAMP)
            last = bisect_right(self._poses, end_ns + largest_gap_s * 1e9, key=_STAMP)
            poses = [p for p in islice(self._poses, first, last) if p.frame == start.frame]
        meanwhile = [p for p in poses if p.stamp_ns <= end_ns]
        if len(meanwhile) < 2:
            meanwhile = poses[: len(meanwhile) + 1]
        return Motion(
            max((float(np.linalg.norm(p.ee2base[:3, 3] - start.ee2base[:3, 3])) for p in meanwhile), default=0.0),
            max((_angle_rad(p.ee2base, start.ee2base) for p in meanwhile), default=0.0),
        )


def _angle_rad(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the angle between two orientations, exact for small ones, which the trace is not."""
    apart = float(np.linalg.norm(a[:3, :3] - b[:3, :3]))
    return 2.0 * math.asin(min(apart / math.sqrt(8.0), 1.0))
