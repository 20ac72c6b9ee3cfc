"""Where the end effector was: its recent poses, looked up by time."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

_KEPT = 10_000  # poses; 100 s at 100 Hz, longer than any C-scan takes to arrive


class PoseHistory:
    """The last poses of one frame in another, each with its stamp; safe from any thread."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, NDArray[np.float64]]] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def add(self, stamp_ns: int, pose: NDArray[np.float64]) -> None:
        """Keep a pose [4, 4]."""
        with self._lock:
            self._poses.append((stamp_ns, pose))

    def nearest(self, stamp_ns: int, largest_gap_s: float) -> NDArray[np.float64] | None:
        """Return the pose nearest in time, None if there is none within `largest_gap_s`."""
        with self._lock:
            found = min(self._poses, key=lambda kept: abs(kept[0] - stamp_ns), default=None)
        if found is None or abs(found[0] - stamp_ns) > largest_gap_s * 1e9:
            return None
        return found[1]
