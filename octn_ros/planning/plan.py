"""A plan: waypoints of the laser focus on the tissue surface, and how far they can be trusted."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from octn_ros.errors import PlanError
from octn_ros.field import Field
from octn_ros.metrics import hit_rate, smoothness_energy_mm2
from octn_ros.planning.calibration import Calibration
from octn_ros.planning.coverage import Coverage, measure_coverage
from octn_ros.planning.envelope import EnvelopeConfig, PathToCheck, check_envelope, refuse_if_too_few
from octn_ros.planning.error_budget import ErrorBudget, ErrorBudgetConfig, error_budget
from octn_ros.planning.first_pass import first_pass
from octn_ros.planning.give_up import GiveUp
from octn_ros.planning.keep_out import KeepOut
from octn_ros.planning.path import path_through
from octn_ros.planning.raster import RasterConfig, RasterPattern, raster_pattern
from octn_ros.planning.region import Region, rectangle_region
from octn_ros.planning.search_config import SurfaceSearchConfig
from octn_ros.planning.search_result import SurfaceSearch
from octn_ros.planning.surface_search import check_inside, find_surface
from octn_ros.planning.waypoints import WaypointConfig, Waypoints, place_waypoints
from octn_ros.settings import as_plain, check_settings, setting


@dataclass(frozen=True)
class PlannerConfig:
    """Everything that decides a plan besides the field, the calibration, the region and what to keep out of."""

    raster: RasterConfig = dataclass_field(default_factory=RasterConfig)
    search: SurfaceSearchConfig = dataclass_field(default_factory=SurfaceSearchConfig)
    waypoints: WaypointConfig = dataclass_field(default_factory=WaypointConfig)
    envelope: EnvelopeConfig = dataclass_field(default_factory=EnvelopeConfig)
    budget: ErrorBudgetConfig = dataclass_field(default_factory=ErrorBudgetConfig)
    speed_m_s: float = setting(5e-3, "speed of the laser focus along a raster line", unit="m/s", low=1e-6, high=1.0)
    tau: float = setting(0.0, "intensity of the surface, 0 to estimate it from the field", low=0.0, high=1.0)

    def __post_init__(self) -> None:
        check_settings(self)


class GivenUpPoint(NamedTuple):
    """A requested waypoint that is not in the path: where in the OCT frame, and why."""

    x_m: float
    y_m: float
    reason: str


@dataclass(frozen=True, eq=False)
class Plan:
    """A path over the surface in the order of travel; read-only.

    Attributes:
        waypoints_oct: poses of the laser focus in the OCT frame [N, 4, 4].
        waypoints_ee: the same in the end-effector frame at the time of the scan [N, 4, 4].
        surface_m: surface points under the waypoints (x, y, z) [N, 3] in the OCT frame, without standoff or depth
            offset; of a lead, the point of its neighbour on the line, moved along.
        segment: number of the straight, gapless stretch each waypoint belongs to [N]; a turn ends one, and so does a
            given-up waypoint.
        laser_on: whether the laser fires at the waypoint [N]; not at lead-ins and lead-outs.
        speed_m_s: speed of the focus at the waypoint [N].
        residual: field intensity less tau at the surface point [N], NaN at leads.
        confidence: how clearly the surface stands out there [N], 0 to 1, NaN at leads.
        tilt_limited: whether the surface is tilted further than the waypoint is allowed to be [N].
        requested: number of waypoints of the raster.
        given_up: number of them that are not in the path.
        given_up_points: where and why.
        coverage: gaps of what is kept of the raster over its region.
        error_budget: how far the laser may miss, by parts.
        tau: intensity of the surface, the median where it is local.
        hit_rate: share of the requested waypoints within the tolerance of tau; given-up ones are misses.
        smoothness_mm2: sum of squared second differences of depth (eq. 13).
        method: how the surface was found, in words.
        seconds: time of the stages: "pattern" (first pass and raster), those of the search, "poses", "checks"
            (envelope, coverage, error budget) and "total".
        field_kind: what the field was made of.
        field_hash: content hash of the field, empty if not told.
        stamp_ns: acquisition time of the scan.
        oct_frame: name of the OCT frame.
        ee_frame: name of the end-effector frame.
        config: the configuration, as JSON can hold it.
    """

    waypoints_oct: NDArray[np.float64]
    waypoints_ee: NDArray[np.float64]
    surface_m: NDArray[np.float64]
    segment: NDArray[np.int32]
    laser_on: NDArray[np.bool_]
    speed_m_s: NDArray[np.float64]
    residual: NDArray[np.float64]
    confidence: NDArray[np.float64]
    tilt_limited: NDArray[np.bool_]
    requested: int
    given_up: int
    given_up_points: tuple[GivenUpPoint, ...]
    coverage: Coverage
    error_budget: ErrorBudget
    tau: float
    hit_rate: float
    smoothness_mm2: float
    method: str
    seconds: dict[str, float]
    field_kind: str
    field_hash: str
    stamp_ns: int
    oct_frame: str
    ee_frame: str
    config: dict[str, Any]


def plan_raster(
    field: Field,
    calibration: Calibration,
    corner_m: ArrayLike,
    opposite_corner_m: ArrayLike,
    angle_rad: float = 0.0,
    config: PlannerConfig | None = None,
    *,
    tau: float | None = None,
    field_hash: str = "",
    keep_out: Sequence[KeepOut] = (),
    scan_ee2base: NDArray[np.float64] | None = None,
) -> Plan:
    """Plan a raster over a rectangle of the surface; see `plan_region` for the other arguments.

    Args:
        field: the field, neural or interpolated.
        calibration: where the OCT probe sits on the end effector.
        corner_m: corner (x, y) in the OCT frame where the path starts, in metres.
        opposite_corner_m: the corner across the diagonal.
        angle_rad: angle of the rectangle's first side against the lateral axis.
        config: all else; the defaults if left out.
        tau: see `plan_region`, as for the rest.
        field_hash, keep_out, scan_ee2base: likewise.

    Raises:
        PlanError: the rectangle is none, or `plan_region` refuses.
    """
    region = rectangle_region(corner_m, opposite_corner_m, angle_rad)
    return plan_region(
        field,
        calibration,
        region,
        config,
        tau=tau,
        field_hash=field_hash,
        keep_out=keep_out,
        scan_ee2base=scan_ee2base,
    )


def plan_region(
    field: Field,
    calibration: Calibration,
    region: Region,
    config: PlannerConfig | None = None,
    *,
    tau: float | None = None,
    field_hash: str = "",
    keep_out: Sequence[KeepOut] = (),
    scan_ee2base: NDArray[np.float64] | None = None,
) -> Plan:
    """Plan a raster over a region of the surface.

    The same arguments give the same path. Thread-safe; any device.

    Args:
        field: the field, neural or interpolated.
        calibration: where the OCT probe sits on the end effector.
        region: what the raster fills; its margin is that of `config.raster`.
        config: all else; the defaults if left out.
        tau: intensity of the surface if it is known already; else the configured one, or an estimate from the field.
        field_hash: identity of the field, kept with the plan.
        keep_out: places the laser must not reach.
        scan_ee2base: pose of the end effector at the time of the scan, for keep-out regions in the base frame.

    Raises:
        PlanError: the region lies outside the field or is too finely spaced, the calibration is for another frame, no
            surface is there, or the path leaves the safety envelope: it says which waypoint, where and why.
    """
    config = config or PlannerConfig()
    if field.geometry.frame != calibration.oct_frame:
        raise PlanError(
            f"expected a field in the calibrated frame {calibration.oct_frame!r}, got {field.geometry.frame!r}; "
            "load the calibration of that scanner"
        )
    began = time.perf_counter()
    check_inside(field.geometry, region.vertices_m, "raster corner")
    region = region.inset(config.raster.margin_m)
    raster = _raster(field, region, config)
    searched = time.perf_counter()
    search = find_surface(field, raster, config.tau or None if tau is None else tau, config.search)
    level = float(np.median(search.tau))
    refuse_if_too_few(search, raster.points_m, level, config.envelope)

    placed = time.perf_counter()
    kept = np.flatnonzero(~search.given_up)
    kept_m = np.column_stack([raster.points_m, search.depth_m])[kept]
    waypoints = place_waypoints(field, kept_m, config.waypoints)
    path = path_through(raster, kept, region.along, config.raster)
    surface_m, waypoints_oct = kept_m[path.source], waypoints.poses_oct[path.source]
    surface_m[:, :2] += path.shift_m
    waypoints_oct[:, :2, 3] += path.shift_m

    checked = time.perf_counter()
    confidence = np.where(path.laser_on, search.confidence[kept][path.source], np.nan)
    check_envelope(
        PathToCheck(
            waypoints_oct[:, :3, 3], surface_m, path.segment, path.laser_on, confidence, waypoints_oct[:, :3, 2]
        ),
        field.geometry,
        config.envelope,
        keep_out,
        calibration,
        scan_ee2base,
    )
    on = path.laser_on
    covered = measure_coverage(region, surface_m[on], path.segment[on], config.raster.line_spacing_m)
    budget = _budget(field, calibration, kept_m, search, waypoints, config)
    ended = time.perf_counter()
    return Plan(
        waypoints_oct=waypoints_oct,
        waypoints_ee=calibration.oct2ee @ waypoints_oct,
        surface_m=surface_m,
        segment=path.segment,
        laser_on=on,
        speed_m_s=np.full(len(on), config.speed_m_s),
        residual=np.where(on, search.residual[kept][path.source], np.nan),
        confidence=confidence,
        tilt_limited=waypoints.tilt_limited[path.source],
        requested=len(raster.segment),
        given_up=int(search.given_up.sum()),
        given_up_points=_given_up_points(raster, search),
        coverage=covered,
        error_budget=budget,
        tau=level,
        hit_rate=hit_rate(search.intensity / search.tau, 1.0, search.given_up, config.search.tolerance),
        smoothness_mm2=smoothness_energy_mm2(surface_m[on, 2], path.segment[on]),
        method=search.method,
        seconds={
            "pattern": searched - began,
            **search.seconds,
            "poses": checked - placed,
            "checks": ended - checked,
            "total": ended - began,
        },
        field_kind=field.kind,
        field_hash=field_hash,
        stamp_ns=field.description.stamp_ns,
        oct_frame=calibration.oct_frame,
        ee_frame=calibration.ee_frame,
        config=as_plain(config),
    )


def _raster(field: Field, region: Region, config: PlannerConfig) -> RasterPattern:
    pattern = raster_pattern(region, config.raster)
    if config.raster.point_spacing_along == "lateral":
        return pattern
    return raster_pattern(region, config.raster, first_pass(field, pattern.points_m, config.search.coarse))


def _given_up_points(raster: RasterPattern, search: SurfaceSearch) -> tuple[GivenUpPoint, ...]:
    lost = np.flatnonzero(search.given_up)
    return tuple(
        GivenUpPoint(float(x), float(y), GiveUp(code).text)
        for (x, y), code in zip(raster.points_m[lost], search.reason[lost], strict=True)
    )


def _budget(
    field: Field,
    calibration: Calibration,
    kept_m: NDArray[np.float64],
    search: SurfaceSearch,
    waypoints: Waypoints,
    config: PlannerConfig,
) -> ErrorBudget:
    level_set = kept_m - (0.0, 0.0, search.offset_correction_m)
    geometry = field.geometry
    points = torch.from_numpy(geometry.metric_to_canonical(level_set).clip(-1.0, 1.0).astype(np.float32))
    _, gradient = field.value_and_gradient(points.to(field.device))
    slope_per_m = gradient[:, 1].cpu().numpy().astype(np.float64) / geometry.metres_per_canonical[1]
    bscan_m, axial_m, lateral_m = geometry.spacing_m
    return error_budget(
        calibration,
        kept_m,
        search.residual[~search.given_up],
        slope_per_m,
        waypoints.normals,
        config.waypoints,
        config.waypoints.normal_radius_voxels * min(bscan_m, lateral_m),
        config.budget,
        roots_m=None if search.root_depth_m is None else search.root_depth_m[~search.given_up],
        min_slope_per_m=config.search.min_gradient / axial_m,
    )
