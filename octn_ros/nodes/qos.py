"""The quality-of-service profiles of the graph, named once."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

# The last value reaches whoever comes later. Both ends must use it: a volatile reader gets nothing it came late for.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# Reports that come in a row, such as the progress of a fit or the pose of the arm.
STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=50,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)

# The same of which a late joiner wants the last: who follows the reports asks with STREAM, who joins with LATCHED.
REPORTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=50,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# Questions by topic and their answers; each may hold a million points, so the queue is short.
REQUESTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)

# rclpy's own for services keeps ten requests, and DDS drops the rest of a hundred that are asked at once.
SERVICES = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)

# What tf2 itself uses on /tf; on /tf_static it is LATCHED.
TRANSFORMS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)

_SMALLEST_SCAN_DEPTH = 1024  # more than the B-scans of any C-scan in the paper; the queue is only filled when needed


RELIABILITIES = ("reliable", "best_effort")


def scan_profile(bscan_count: int, reliability: str = "reliable") -> QoSProfile:
    """Return the profile of `bscan` and `bscan_pose`: a whole C-scan fits into the queue.

    Args:
        bscan_count: B-scans of a C-scan, 0 if unknown.
        reliability: one of `RELIABILITIES`. A reliable subscriber hears nothing from a best-effort scanner.
    """
    best_effort = reliability == "best_effort"
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(bscan_count, _SMALLEST_SCAN_DEPTH),
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )
