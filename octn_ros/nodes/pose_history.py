"""Where the end effector was: its recent poses, looked up by time, and how far it moved meanwhile."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_KEPT = 10_000  # poses; 100 s at 100 Hz, longer than any C-scan takes to arrive


@dataclass(frozen=True, eq=False)
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
    """The last poses, looked up by their stamps; safe from any thread."""

    def __init__(self) -> None:
        self._poses: deque[StampedPose] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return how many poses are kept."""
        return len(self._poses)

    def add(self, pose: StampedPose) -> None:
        """Keep a pose."""
        with self._lock:
            self._poses.append(pose)

    def nearest(self, stamp_ns: int, largest_gap_s: float) -> StampedPose | None:
        """Return the pose nearest in time, None if there is none within `largest_gap_s`."""
        with self._lock:
            found = min(self._poses, key=lambda kept: abs(kept.stamp_ns - stamp_ns), default=None)
        if found is None or abs(found.stamp_ns - stamp_ns) > largest_gap_s * 1e9:
            return None
        return found

    def heard_until(self, stamp_ns: int) -> bool:
        """Return whether a pose of this time or later has come."""
        with self._lock:
            return any(kept.stamp_ns >= stamp_ns for kept in reversed(self._poses))

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
            poses = sorted((p for p in self._poses if p.frame == start.frame), key=lambda kept: kept.stamp_ns)
        meanwhile = [p for p in poses if start_ns <= p.stamp_ns <= end_ns]
        after = [p for p in poses if end_ns < p.stamp_ns <= end_ns + largest_gap_s * 1e9]
        if len(meanwhile) < 2:
            meanwhile += after[:1]
        return Motion(
            max((float(np.linalg.norm(p.ee2base[:3, 3] - start.ee2base[:3, 3])) for p in meanwhile), default=0.0),
            max((_angle_rad(p.ee2base, start.ee2base) for p in meanwhile), default=0.0),
        )


def _angle_rad(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the angle between two orientations, exact for small ones, which the trace is not."""
    apart = float(np.linalg.norm(a[:3, :3] - b[:3, :3]))
    return 2.0 * math.asin(min(apart / math.sqrt(8.0), 1.0))
