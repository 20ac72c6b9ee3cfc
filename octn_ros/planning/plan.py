"""A plan: waypoints of the laser focus on the tissue surface, and how far they can be trusted."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.errors import PlanError, QueryError
from octn_ros.field import Field
from octn_ros.metrics import hit_rate, smoothness_energy_mm2
from octn_ros.planning.calibration import Calibration
from octn_ros.planning.raster import RasterConfig, RasterPattern, rectangle_raster
from octn_ros.planning.region import rectangle_corners
from octn_ros.planning.surface_search import GiveUp, SurfaceSearch, SurfaceSearchConfig, check_inside, find_surface
from octn_ros.planning.transforms import quaternions_xyzw
from octn_ros.planning.waypoints import WaypointConfig, inward_normals, waypoint_poses
from octn_ros.query import surface_intensity, surface_map
from octn_ros.settings import as_plain, check_settings, setting

_BEAM = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class PlannerConfig:
    """Everything that decides a plan besides the field, the calibration and the rectangle."""

    raster: RasterConfig = dataclass_field(default_factory=RasterConfig)
    search: SurfaceSearchConfig = dataclass_field(default_factory=SurfaceSearchConfig)
    waypoints: WaypointConfig = dataclass_field(default_factory=WaypointConfig)
    speed_m_s: float = setting(5e-3, "speed of the laser focus along a raster line", unit="m/s", low=1e-6, high=1.0)
    tau: float = setting(0.0, "intensity of the surface, 0 to estimate it from the field", low=0.0, high=1.0)
    max_given_up: float = setting(0.2, "share of given-up waypoints above which the plan is refused", low=0.0, high=1.0)

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
        surface_m: surface points under the waypoints (x, y, z) [N, 3] in the OCT frame, without standoff.
        segment: number of the straight, gapless stretch each waypoint belongs to [N]; a turn ends one, and so does a
            given-up waypoint.
        laser_on: whether the laser fires at the waypoint [N].
        speed_m_s: speed of the focus at the waypoint [N].
        residual: field intensity less tau at the surface point [N].
        confidence: how clearly the surface stands out there [N], 0 to 1.
        requested: number of waypoints of the raster.
        given_up: number of them that are not in the path.
        given_up_points: where and why.
        tau: intensity of the surface.
        hit_rate: share of the requested waypoints within the tolerance of tau; given-up ones are misses.
        smoothness_mm2: sum of squared second differences of depth (eq. 13).
        method: how the surface was found, in words.
        seconds: time of the stages "tau", "coarse", "refine", "poses" and "total".
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
    requested: int
    given_up: int
    given_up_points: tuple[GivenUpPoint, ...]
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
) -> Plan:
    """Plan a zigzag raster over a rectangle of the surface.

    The same arguments give the same path. Thread-safe; any device.

    Args:
        field: the field, neural or interpolated.
        calibration: where the OCT probe sits on the end effector.
        corner_m: corner (x, y) in the OCT frame where the path starts, in metres.
        opposite_corner_m: the corner across the diagonal.
        angle_rad: angle of the rectangle's first side against the lateral axis.
        config: all else; the defaults if left out.
        tau: intensity of the surface if it is known already; else the configured one, or an estimate from the field.
        field_hash: identity of the field, kept with the plan.

    Raises:
        PlanError: the rectangle is empty, outside the field or too finely spaced, the calibration is for another frame,
            no surface is there, or too large a share of the waypoints was given up.
    """
    config = config or PlannerConfig()
    if field.geometry.frame != calibration.oct_frame:
        raise PlanError(
            f"expected a field in the calibrated frame {calibration.oct_frame!r}, got {field.geometry.frame!r}; "
            "load the calibration of that scanner"
        )
    began = time.perf_counter()
    corners = rectangle_corners(corner_m, opposite_corner_m, angle_rad)
    check_inside(field.geometry, corners, "raster corner")
    raster = rectangle_raster(corner_m, opposite_corner_m, angle_rad, config.raster)
    level = _tau(field, config, tau)
    tau_done = time.perf_counter()
    search = find_surface(field, raster.points_m, level, config.search)
    _refuse_if_too_few(search, raster, level, config)

    poses_began = time.perf_counter()
    kept = np.flatnonzero(~search.given_up)
    surface_m = np.column_stack([raster.points_m, search.depth_m])[kept]
    z_axis = _BEAM
    if config.waypoints.orientation == "normal":
        z_axis = inward_normals(field, surface_m, config.waypoints.normal_radius_voxels)
    waypoints_oct = waypoint_poses(surface_m, z_axis, config.waypoints.standoff_m)
    segment = _segments(raster.segment[kept], kept)
    ended = time.perf_counter()
    lost = np.flatnonzero(search.given_up)
    return Plan(
        waypoints_oct=waypoints_oct,
        waypoints_ee=calibration.oct2ee @ waypoints_oct,
        surface_m=surface_m,
        segment=segment,
        laser_on=np.ones(len(kept), dtype=np.bool_),
        speed_m_s=np.full(len(kept), config.speed_m_s),
        residual=search.residual[kept],
        confidence=search.confidence[kept],
        requested=len(raster.segment),
        given_up=len(lost),
        given_up_points=tuple(
            GivenUpPoint(float(x), float(y), GiveUp(code).text)
            for (x, y), code in zip(raster.points_m[lost], search.reason[lost], strict=True)
        ),
        tau=level,
        hit_rate=hit_rate(search.intensity, level, search.given_up, config.search.tolerance),
        smoothness_mm2=smoothness_energy_mm2(surface_m[:, 2], segment),
        method=search.method,
        seconds={
            "tau": tau_done - began,
            **search.seconds,
            "poses": ended - poses_began,
            "total": ended - began,
        },
        field_kind=field.kind,
        field_hash=field_hash,
        stamp_ns=field.description.stamp_ns,
        oct_frame=calibration.oct_frame,
        ee_frame=calibration.ee_frame,
        config=as_plain(config),
    )


def plan_to_plain(plan: Plan) -> dict[str, Any]:
    """Return a plan as numbers, strings, lists and dicts that JSON can hold; poses as position and quaternion."""
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
            "residual": plan.residual.tolist(),
            "confidence": plan.confidence.tolist(),
        },
    }


def _tau(field: Field, config: PlannerConfig, tau: float | None) -> float:
    if tau is not None:
        return tau
    if config.tau > 0:
        return config.tau
    try:
        return surface_intensity(surface_map(field, config.search.coarse))
    except QueryError as error:
        raise PlanError(f"no surface to estimate tau from: {error}") from error


def _refuse_if_too_few(search: SurfaceSearch, raster: RasterPattern, tau: float, config: PlannerConfig) -> None:
    lost = np.flatnonzero(search.given_up)
    share = len(lost) / len(search.given_up)
    if share <= config.max_given_up and share < 1.0:
        return
    code, count = Counter(search.reason[lost].tolist()).most_common(1)[0]
    x, y = raster.points_m[lost[0]] * 1e3
    raise PlanError(
        f"expected at most {config.max_given_up:.0%} of the waypoints given up, got {len(lost)} of "
        f"{len(search.given_up)} ({share:.0%}), {count} of them because {GiveUp(code).text} (tau {tau:.3f}); the first "
        f"at ({x:.3f}, {y:.3f}) mm. Move the raster to clear tissue, or scan again"
    )


def _segments(line: NDArray[np.int32], index: NDArray[np.intp]) -> NDArray[np.int32]:
    """Number the stretches of the path: a new raster line starts one, and so does a gap in the raster index."""
    starts = (np.diff(line) != 0) | (np.diff(index) != 1)
    return np.concatenate(([0], np.cumsum(starts))).astype(np.int32)
