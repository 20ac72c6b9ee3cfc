"""The safety envelope: what every plan must keep to before anybody sees it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import PlanError
from octn_ros.planning.calibration import Calibration
from octn_ros.planning.give_up import GiveUp
from octn_ros.planning.keep_out import KeepOut
from octn_ros.planning.search_result import SurfaceSearch
from octn_ros.planning.waypoints import BEAM
from octn_ros.settings import check_settings, setting
from octn_ros.volume import VolumeGeometry

_INSIDE_M = 1e-9
# Beams between two waypoints that are held against keep-out regions lie at most this far apart.
_BETWEEN_M = 4e-6
# Shortest step along a beam; half of it and half the way to the next beam are added to the clearance, so that nothing
# between is missed.
_STEP_M = 0.5e-6
# Waypoints whose beams are held against a region together, which bounds the memory.
_CHUNK = 20_000
_NAMED_VIOLATIONS = 3


@dataclass(frozen=True)
class EnvelopeConfig:
    """Limits of a plan; a violation refuses it as a whole. 0 switches a limit off where it says so."""

    max_given_up: float = setting(0.2, "share of given-up waypoints above which the plan is refused", low=0.0, high=1.0)
    min_confidence: float = setting(
        0.0, "confidence below which a waypoint refuses the plan, 0 for none", low=0.0, high=1.0
    )
    max_depth_m: float = setting(
        0.0, "largest depth of the focus below the scan's first voxel, 0 for the depth of the scan", unit="m", low=0.0
    )
    max_step_m: float = setting(
        500e-6, "largest difference in depth between neighbours of a line, 0 for none", unit="m", low=0.0
    )
    max_slope_deg: float = setting(
        0.0, "largest slope between neighbours of a line against the lateral plane, 0 for none", unit="deg", low=0.0,
        high=90.0,
    )  # fmt: skip
    clearance_m: float = setting(
        0.0, "distance kept from keep-out regions, such as half a spot", unit="m", low=0.0, high=0.01
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, eq=False)
class PathToCheck:
    """A path as the envelope sees it, in the OCT frame, in the order of travel.

    Attributes:
        focus_m: focus (x, y, z) of each waypoint [N, 3].
        surface_m: surface point under it [N, 3].
        segment: gapless stretch it belongs to [N].
        laser_on: whether the laser fires there [N].
        confidence: of its surface point [N]; not read where the laser is off.
        axis: unit z of each waypoint [N, 3], along which the laser comes; the OCT beam if left out.
    """

    focus_m: NDArray[np.float64]
    surface_m: NDArray[np.float64]
    segment: NDArray[np.int32]
    laser_on: NDArray[np.bool_]
    confidence: NDArray[np.float64]
    axis: NDArray[np.float64] | None = None


class Violation(NamedTuple):
    """One limit that one waypoint breaks: its number in the path, where it is in the OCT frame, and why it is wrong."""

    waypoint: int
    place_m: tuple[float, float, float]
    rule: str
    reason: str


def refuse_if_too_few(search: SurfaceSearch, points_m: NDArray[np.float64], tau: float, config: EnvelopeConfig) -> None:
    """Refuse a plan of which too large a share was given up.

    Raises:
        PlanError: says the share, the most frequent reason and the first place.
    """
    lost = np.flatnonzero(search.given_up)
    share = len(lost) / len(search.given_up)
    if share <= config.max_given_up and share < 1.0:
        return
    code, count = Counter(search.reason[lost].tolist()).most_common(1)[0]
    x, y = points_m[lost[0]] * 1e3
    raise PlanError(
        f"expected at most {config.max_given_up:.0%} of the waypoints given up, got {len(lost)} of "
        f"{len(search.given_up)} ({share:.0%}), {count} of them because {GiveUp(code).text} (tau {tau:.3f}); the first "
        f"at ({x:.3f}, {y:.3f}) mm. Move the raster to clear tissue, give tau where "
        "another is known (octn surface tells one), plan on a fitted field, or scan again"
    )


def check_envelope(
    path: PathToCheck,
    geometry: VolumeGeometry,
    config: EnvelopeConfig,
    keep_out: Sequence[KeepOut] = (),
    calibration: Calibration | None = None,
    scan_ee2base: NDArray[np.float64] | None = None,
) -> None:
    """Refuse a path that leaves the envelope.

    A waypoint lies inside the scanned field if its surface point does, its focus does laterally, and its focus is no
    deeper than the scan; a standoff may lift the focus above the first voxel, where there is air. Held against keep-out
    regions are the focus, the way of the focus between two waypoints that both fire, and where the laser fires its beam
    above the focus, along the waypoint's z up to the depth of the first voxel. Above that, and of the cone that the
    beam is, nothing is checked.

    Raises:
        PlanError: names how many waypoints break which limits, and the first ones, where and why; or a keep-out
            region cannot be placed.
    """
    violations = find_violations(path, geometry, config, keep_out, calibration, scan_ee2base)
    if not violations:
        return
    rules = ", ".join(f"{count} {rule}" for rule, count in Counter(each.rule for each in violations).items())
    named = "; ".join(
        f"waypoint {each.waypoint} at ({each.place_m[0] * 1e3:.3f}, {each.place_m[1] * 1e3:.3f}, "
        f"{each.place_m[2] * 1e3:.3f}) mm: {each.reason}"
        for each in violations[:_NAMED_VIOLATIONS]
    )
    more = f"; and {len(violations) - _NAMED_VIOLATIONS} more" if len(violations) > _NAMED_VIOLATIONS else ""
    raise PlanError(
        f"expected a path inside the safety envelope, got violations ({rules}): {named}{more}. Move or shrink the "
        "raster, or change the limit knowingly"
    )


def find_violations(
    path: PathToCheck,
    geometry: VolumeGeometry,
    config: EnvelopeConfig,
    keep_out: Sequence[KeepOut] = (),
    calibration: Calibration | None = None,
    scan_ee2base: NDArray[np.float64] | None = None,
) -> list[Violation]:
    """Return all violations in the order of travel; see `check_envelope`."""
    found = [
        *_outside_field(path, geometry),
        *_too_deep(path, geometry, config),
        *_too_steep(path, config),
        *_unsure(path, config),
    ]
    for region in keep_out:
        if calibration is None:
            raise PlanError(f"expected a calibration to place the keep-out region {region.name!r}, got none")
        found += _forbidden(path, geometry, region, config, calibration, scan_ee2base)
    return sorted(found, key=lambda violation: violation.waypoint)


def _violations(path: PathToCheck, where: NDArray[np.bool_], rule: str, reasons: Sequence[str]) -> list[Violation]:
    return [
        Violation(int(index), tuple(path.focus_m[index].tolist()), rule, reason)
        for index, reason in zip(np.flatnonzero(where), reasons, strict=True)
    ]


def _outside_field(path: PathToCheck, geometry: VolumeGeometry) -> list[Violation]:
    low = np.array(geometry.origin_m)
    high = low + np.array(geometry.extent_m)
    focus, surface = path.focus_m, path.surface_m
    # NaN fails these comparisons too.
    good = ((surface >= low - _INSIDE_M) & (surface <= high + _INSIDE_M)).all(axis=1)
    good &= ((focus[:, :2] >= low[:2] - _INSIDE_M) & (focus[:, :2] <= high[:2] + _INSIDE_M)).all(axis=1)
    good &= focus[:, 2] <= high[2] + _INSIDE_M
    reason = (
        f"outside the scanned field, x {low[0] * 1e3:.3f} to {high[0] * 1e3:.3f} mm, y {low[1] * 1e3:.3f} to "
        f"{high[1] * 1e3:.3f} mm, z {low[2] * 1e3:.3f} to {high[2] * 1e3:.3f} mm"
    )
    return _violations(path, ~good, "outside the scanned field", [reason] * int((~good).sum()))


def _too_deep(path: PathToCheck, geometry: VolumeGeometry, config: EnvelopeConfig) -> list[Violation]:
    if config.max_depth_m <= 0.0:
        return []
    depth = path.focus_m[:, 2] - geometry.origin_m[2]
    deep = depth > config.max_depth_m
    limit = f"deeper than {config.max_depth_m * 1e3:.3f} mm below the first voxel"
    return _violations(path, deep, "too deep", [f"{z * 1e3:.3f} mm, {limit}" for z in depth[deep]])


def _too_steep(path: PathToCheck, config: EnvelopeConfig) -> list[Violation]:
    found = []
    joined = (np.diff(path.segment) == 0) & path.laser_on[1:] & path.laser_on[:-1]
    along = np.diff(path.surface_m, axis=0)
    step, lateral = np.abs(along[:, 2]), np.linalg.norm(along[:, :2], axis=1)
    slope = np.degrees(np.arctan2(step, lateral))
    if config.max_step_m > 0.0:
        bad = np.append(False, joined & (step > config.max_step_m))
        limit = f"above the largest of {config.max_step_m * 1e6:g} um"
        reasons = [f"a step of {size * 1e6:.1f} um from the waypoint before, {limit}" for size in step[bad[1:]]]
        found += _violations(path, bad, "steps in depth", reasons)
    if config.max_slope_deg > 0.0:
        bad = np.append(False, joined & (slope > config.max_slope_deg))
        limit = f"above the largest of {config.max_slope_deg:g} degrees"
        reasons = [f"a slope of {angle:.1f} degrees from the waypoint before, {limit}" for angle in slope[bad[1:]]]
        found += _violations(path, bad, "slopes", reasons)
    return found


def _unsure(path: PathToCheck, config: EnvelopeConfig) -> list[Violation]:
    bad = path.laser_on & ~(path.confidence >= config.min_confidence)
    if config.min_confidence <= 0.0 or not bad.any():
        return []
    limit = f"below the least of {config.min_confidence:g}"
    return _violations(path, bad, "of low confidence", [f"confidence {c:.3f}, {limit}" for c in path.confidence[bad]])


def _forbidden(
    path: PathToCheck,
    geometry: VolumeGeometry,
    region: KeepOut,
    config: EnvelopeConfig,
    calibration: Calibration,
    scan_ee2base: NDArray[np.float64] | None,
) -> list[Violation]:
    """Waypoints in or under a region, or too close to it, and those from which the next one is reached so."""
    focus = path.focus_m
    axis = np.broadcast_to(BEAM, focus.shape) if path.axis is None else path.axis
    height = np.where(path.laser_on, np.maximum(focus[:, 2] - geometry.origin_m[2], 0.0), 0.0)
    top = focus - (height / axis[:, 2])[:, None] * axis
    fired = np.append((np.diff(path.segment) == 0) & path.laser_on[1:] & path.laser_on[:-1], False)
    at_focus, in_beam = np.full(len(focus), np.inf), np.full(len(focus), np.inf)

    def distance_m(places: NDArray[np.float64]) -> NDArray[np.float64]:
        return region.distance_m(places, calibration.oct2ee, scan_ee2base)

    for start in range(0, len(focus), _CHUNK):
        chunk = np.arange(start, min(start + _CHUNK, len(focus)))
        following = np.minimum(chunk + 1, len(focus) - 1)
        low_leg, high_leg = focus[following] - focus[chunk], top[following] - top[chunk]
        leg = np.fmax(np.linalg.norm(low_leg, axis=1), np.linalg.norm(high_leg, axis=1))
        leg = np.where(fired[chunk] & np.isfinite(leg), leg, 0.0)
        parts = np.ceil(leg / _BETWEEN_M).astype(np.intp).clip(1, math.ceil(1e-2 / _BETWEEN_M))
        beam = np.repeat(np.arange(len(chunk)), parts)
        share = ((np.arange(len(beam)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[beam])[:, None]
        allowed = config.clearance_m + 0.5 * (leg / parts)[beam]
        below, along = _approach(
            distance_m, focus[chunk][beam] + share * low_leg[beam], top[chunk][beam] + share * high_leg[beam], allowed
        )
        np.minimum.at(at_focus, chunk[beam], np.where(below <= allowed, below, np.inf))
        np.minimum.at(in_beam, chunk[beam], np.where(along <= allowed + 0.5 * _STEP_M, along, np.inf))
    bad = np.isfinite(at_focus) | np.isfinite(in_beam)
    what = f"the keep-out region {region.name!r} ({region.shape} in {region.frame})"
    reasons = [
        _closeness(what, at, config.clearance_m)
        if np.isfinite(at)
        else f"its beam comes within {crossed * 1e6:.1f} um of {what}"
        for at, crossed in zip(at_focus[bad], in_beam[bad], strict=True)
    ]
    return _violations(path, bad, f"at keep-out region {region.name!r}", reasons)


def _closeness(what: str, distance_m: float, clearance_m: float) -> str:
    if distance_m == 0.0:
        return f"in {what}"
    limit = f"nearer than {clearance_m * 1e6:g} um"
    return f"{distance_m * 1e6:.1f} um from {what}, {limit if distance_m <= clearance_m else f'perhaps {limit}'}"


def _approach(
    distance_m: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    allowed: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Walk along stretches [N, 3] in steps as long as what is free around.

    A distance changes by no more than one walks, so what comes nearer than `allowed` [N] is met within half a step.

    Returns:
        Distance at the starts [N], and the least one that was met [N].
    """
    way = end - start
    length = np.linalg.norm(way, axis=1)
    direction = way / np.where(length > 0.0, length, 1.0)[:, None]
    walked, first, least = np.zeros(len(start)), np.empty(0), np.full(len(start), np.inf)
    active = np.arange(len(start))
    while len(active):
        distance = distance_m(start[active] + walked[active, None] * direction[active])
        first = distance if len(first) == 0 else first
        least[active] = np.minimum(least[active], distance)
        walked[active] += np.maximum(distance - allowed[active], _STEP_M)
        active = active[(distance > allowed[active] + 0.5 * _STEP_M) & (walked[active] <= length[active])]
    return first, least
