"""The interlock: the conditions under which the laser may be on, and which of them fails."""

from __future__ import annotations

from dataclasses import dataclass

from octn_ros.errors import ConfigurationError
from octn_ros.settings import check_settings, setting

SIGN_OF_LIFE_S = 1.0
"""Time from one sign of life of a planner to its next."""


@dataclass(frozen=True)
class InterlockConfig:
    """What the laser is turned off by, besides an abort."""

    plan_max_age_s: float = setting(600.0, "age of the scan beyond which its plan is not fired", unit="s", low=0.0)
    max_tissue_motion_m: float = setting(
        100e-6, "distance of the tracked tissue from its place at the scan beyond which nothing is fired; 0 = not "
        "watched", unit="m", low=0.0, high=0.1,
    )  # fmt: skip
    longest_stall_s: float = setting(
        0.5, "time without a look at all this, with the shutter open, after which nothing more is fired", unit="s",
        low=0.01, high=60.0,
    )  # fmt: skip
    planner_silence_s: float = setting(
        5.0, "time without a sign of life of the planner after which nothing more is fired; more than longest_stall_s "
        "and the second from one sign to the next", unit="s", low=1.5, high=120.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_settings(self)
        # While this process is held up it hears nothing, which must not be taken for a planner's silence.
        least_s = SIGN_OF_LIFE_S + self.longest_stall_s
        if not self.planner_silence_s > least_s:
            raise ConfigurationError(
                f"expected planner_silence_s above {least_s:g} s, which are longest_stall_s and the time from one sign "
                f"of life to the next, got {self.planner_silence_s:g} s; raise it, or lower longest_stall_s"
            )


@dataclass(frozen=True)
class Conditions:
    """What is known when the laser is about to be on.

    Attributes:
        enabled: whether a person has enabled the laser.
        plan_age_s: time since the scan that the plan was made on, by the clock that stamped it.
        unvouched: why no planner stands for the plan, None if one does.
        tissue_moved_m: measured distance of the tissue from its place at that scan.
        stalled_s: time since these conditions were last looked at, by the clock that stamped the scan; at most 0 with
            the shutter closed.
    """

    enabled: bool
    plan_age_s: float
    unvouched: str | None
    tissue_moved_m: float
    stalled_s: float


def why_off(config: InterlockConfig, conditions: Conditions) -> str | None:
    """Return the first reason why the laser must be off, None if it may be on; pure and thread-safe."""
    if not conditions.enabled:
        return "expected an enabled laser, got a disabled one; call enable_laser first"
    if not 0.0 <= conditions.plan_age_s <= config.plan_max_age_s:
        return (
            f"expected a plan whose scan is 0 to {config.plan_max_age_s:g} s old, got one of "
            f"{conditions.plan_age_s:.1f} s; scan and plan again"
        )
    if conditions.unvouched is not None:
        return conditions.unvouched
    # A distance that is not a number is no reason to fire.
    if config.max_tissue_motion_m > 0.0 and not conditions.tissue_moved_m <= config.max_tissue_motion_m:
        return (
            f"expected tissue within {config.max_tissue_motion_m * 1e6:.0f} um of its place at the scan, got it "
            f"{conditions.tissue_moved_m * 1e6:.0f} um away; scan and plan again"
        )
    if conditions.stalled_s < 0.0:
        return f"expected a clock that goes on, got one set back by {-conditions.stalled_s:.2f} s; scan and plan again"
    if not conditions.stalled_s <= config.longest_stall_s:
        return (
            f"expected a look at the interlock every {config.longest_stall_s:g} s at least while the shutter is "
            f"open, got none for {conditions.stalled_s:.2f} s; take load off the computer, scan and plan again"
        )
    return None
