"""Who stands for a plan: one planner, alive, that names the very plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from octn_ros.simulation.laser_path import LaserPath


@dataclass(frozen=True)
class Voucher:
    """What is known of the planner and of the plan that it stands for; immutable and thread-safe.

    Attributes:
        publishers: how many publish each of the topics that make a plan, by their names.
        silent_s: time since the planner's last sign of life, infinite before the first.
        lives_for: the plan that this sign named, by hash.
        planner: the planner, as its status names it.
        node: full name of its node, whose signs of life count.
        scan: time of the scan that its plan was made on, nanoseconds as it wrote them.
        plan_hash: of its plan, empty if it has none.
        field_hash: of the field that its plan was made on.
    """

    publishers: Mapping[str, int]
    silent_s: float = math.inf
    lives_for: str = ""
    planner: str = ""
    node: str = ""
    scan: str = ""
    plan_hash: str = ""
    field_hash: str = ""

    @property
    def why_nobody(self) -> str | None:
        """Why there is not one planner in the graph, None if there is."""
        counts = self.publishers.values()
        if max(counts, default=0) > 1:
            found = ", ".join(f"{topic} from {count}" for topic, count in self.publishers.items())
            return (
                f"expected the topics of a plan from one publisher each, got {found}; end all planners but one (one "
                "that was killed is in the graph for some seconds more: wait), then plan again"
            )
        missing = " and ".join(topic for topic, count in self.publishers.items() if not count)
        if missing or not counts:
            return (
                f"expected the planner that made the plan, got nobody in the graph who publishes {missing or 'plans'}; "
                "start it, scan and plan again"
            )
        return None

    def why_not(self, path: LaserPath, longest_silence_s: float) -> str | None:
        """Return why nobody stands for a plan now, None if one planner does.

        Args:
            path: the plan.
            longest_silence_s: of the planner.
        """
        if self.why_nobody is not None:
            return self.why_nobody
        same = (self.plan_hash, self.scan) == (path.hash, str(path.stamp_ns))
        if not (same and path.hash and self.field_hash):
            return (
                f"expected a plan_status with plan_hash {path.hash}, stamp_ns {path.stamp_ns} and a field_hash, got "
                f"{self.plan_hash or 'none'}, {self.scan or 'none'} and {self.field_hash or 'none'}; plan again"
            )
        do = "is its process stopped or stuck? restart it"
        # Never heard of is infinitely silent.
        if not self.silent_s <= longest_silence_s:
            got = f"none for {self.silent_s:.1f} s" if math.isfinite(self.silent_s) else "none yet"
        elif self.lives_for != path.hash:
            got, do = f"one with {self.lives_for or 'none'}", "plan again"
        else:
            return None
        node = self.node or "not named in plan_status"
        return (
            f"expected a sign of life of the planner (node {node}) on /diagnostics with plan_hash {path.hash} every "
            f"{longest_silence_s:g} s, got {got}; {do}"
        )
