"""The figures of a plan that `octn plan` prints, for machines and for people."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from octn_ros.planning import Plan


def plan_figures(plan: Plan) -> dict[str, Any]:
    """Return what is printed of a plan, as JSON can hold it."""
    return {
        "waypoints": int(plan.laser_on.sum()),
        "leads": int((~plan.laser_on).sum()),
        "requested": plan.requested,
        "given_up": plan.given_up,
        "given_up_because": dict(Counter(point.reason for point in plan.given_up_points)),
        "lateral_m": _range(plan, 0),
        "bscan_m": _range(plan, 1),
        "tilt_limited": int(plan.tilt_limited.sum()),
        "tau": plan.tau,
        "hit_rate": plan.hit_rate,
        "smoothness_mm2": plan.smoothness_mm2,
        "coverage": dataclasses.asdict(plan.coverage),
        "error_budget": plan.error_budget.to_plain(),
        "method": plan.method,
        "seconds": plan.seconds,
        "field_hash": plan.field_hash,
    }


def plan_rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the table for people, from `plan_figures` and the name of the file."""
    covered, budget = values["coverage"], values["error_budget"]
    because = "".join(f"; {count}: {reason}" for reason, count in values["given_up_because"].items())
    leads = f", {values['leads']} leads with the laser off" if values["leads"] else ""
    lacking = f", without {', '.join(budget['not_stated'])} (not stated)" if budget["not_stated"] else ""
    rows = [
        ("waypoints", f"{values['waypoints']} of {values['requested']}, {values['given_up']} given up{because}{leads}"),
        ("place", f"{_words(values['lateral_m'])} mm lateral, {_words(values['bscan_m'])} mm bscan, in the OCT frame"),
        ("hit rate", f"{100 * values['hit_rate']:.1f} % within 5 % of tau = {values['tau']:.3f}"),
        ("smoothness energy", f"{values['smoothness_mm2']:.4g} mm^2"),
        (
            "widest gap",
            f"{covered['line_gap_m'] * 1e6:.1f} um between lines ({covered['surface_line_gap_m'] * 1e6:.1f} on the "
            f"surface), {covered['border_gap_m'] * 1e6:.1f} um to the border, {100 * covered['open_share']:.2g} % of "
            "the region in gaps wider than the line spacing",
        ),
        *(
            (f"error budget: {term['name']}", f"{term['micrometres']:.2f} um, {term['source']}")
            for term in budget["terms"]
            if term["micrometres"]
        ),
        ("error budget, in all", f"{budget['total_um']:.1f} um{lacking}"),
        ("surface search", values["method"]),
        ("time", ", ".join(f"{name} {value:.2f} s" for name, value in values["seconds"].items())),
        ("plan", values["plan"]),
    ]
    if values["tilt_limited"]:
        rows.insert(1, ("tilted to the limit", f"{values['tilt_limited']} waypoints"))
    return rows


def _range(plan: Plan, axis: int) -> list[float]:
    """Return the first and the last place on one axis of the OCT frame where the laser is on, in metres."""
    places = plan.waypoints_oct[plan.laser_on, axis, 3]
    return [float(places.min()), float(places.max())]


def _words(range_m: list[float]) -> str:
    return " to ".join(f"{place * 1e3:.3f}" for place in range_m)
