"""Where the end effector was: its recent poses, looked up by time."""

from __future__ import annotations

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


class PoseHistory:
    """The last poses, looked up by their stamps; safe from any thread."""

    def __init__(self) -> None:
        self._poses: deque[StampedPose] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

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
