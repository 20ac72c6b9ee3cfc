"""A plan as other programs read it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.planning.plan import Plan
from octn_ros.planning.transforms import quaternions_xyzw


def plan_to_plain(plan: Plan) -> dict[str, Any]:
    """Return a plan as numbers, strings, lists and dicts that JSON can hold; poses as position and quaternion.

    What a lead-in or lead-out has no number for is None.
    """
    positions, quaternions = plan.waypoints_ee[:, :3, 3], quaternions_xyzw(plan.waypoints_ee)
    return {
        "frame": plan.ee_frame,
        "oct_frame": plan.oct_frame,
        "stamp_ns": plan.stamp_ns,
        "field_kind": plan.field_kind,
        "field_hash": plan.field_hash,
        "method": plan.method,
        "tau": plan.tau,
        "requested": plan.requested,
        "given_up": plan.given_up,
        "given_up_points": [point._asdict() for point in plan.given_up_points],
        "coverage": dataclasses.asdict(plan.coverage),
        "error_budget": plan.error_budget.to_plain(),
        "hit_rate": plan.hit_rate,
        "smoothness_mm2": plan.smoothness_mm2,
        "seconds": dict(plan.seconds),
        "config": plan.config,
        "waypoints": {
            "position_m": positions.tolist(),
            "quaternion_xyzw": quaternions.tolist(),
            "surface_oct_m": plan.surface_m.tolist(),
            "segment": plan.segment.tolist(),
            "laser_on": plan.laser_on.tolist(),
            "speed_m_s": plan.speed_m_s.tolist(),
            "residual": _numbers_or_none(plan.residual),
            "confidence": _numbers_or_none(plan.confidence),
            "tilt_limited": plan.tilt_limited.tolist(),
        },
    }


def _numbers_or_none(values: NDArray[np.float64]) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]
