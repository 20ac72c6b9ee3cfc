"""Waypoints: poses of the laser focus on the surface."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.errors import ConfigurationError, PlanError
from octn_ros.field import Field
from octn_ros.settings import check_settings, setting

ORIENTATIONS = ("beam", "normal")
STANDOFF_ALONG = ("pose", "beam", "normal")
BEAM = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class WaypointConfig:
    """Where the laser focus lies with respect to the surface, and which way it looks.

    Raises:
        ConfigurationError: a value is not allowed, or both a standoff and a depth offset are given.
    """

    orientation: str = setting("beam", "z of a waypoint: along the beam or the inward normal", choices=ORIENTATIONS)
    max_tilt_deg: float = setting(
        45.0, "largest angle of a waypoint's z against the beam, for orientation normal", unit="deg", low=0.0, high=89.0
    )
    beyond_tilt: str = setting(
        "limit", "what becomes of a waypoint whose normal is tilted further: tilted to the limit and flagged, or the "
        "plan refused", choices=("limit", "refuse"),
    )  # fmt: skip
    standoff_m: float = setting(
        0.0, "distance of the focus from the surface; positive lies towards the probe", unit="m",
        low=-0.01, high=0.01,
    )  # fmt: skip
    standoff_along: str = setting(
        "pose", "direction of the standoff: against the waypoint's own z, the OCT beam or the inward normal",
        choices=STANDOFF_ALONG,
    )  # fmt: skip
    depth_offset_m: float = setting(
        0.0, "depth of the focus below the surface as optical path, as the volume shows it; the focus lies this over "
        "the refractive index along the refracted OCT beam", unit="m", low=0.0, high=0.01,
    )  # fmt: skip
    refractive_index: float = setting(1.38, "group refractive index of the tissue", low=1.0, high=3.0)
    normal_radius_voxels: float = setting(
        2.0, "lateral reach of the gradients that are averaged to a normal", unit="voxels", low=0.0, high=20.0
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if self.standoff_m != 0.0 and self.depth_offset_m != 0.0:
            raise ConfigurationError(
                "WaypointConfig: expected a standoff or a depth offset, got both "
                f"({self.standoff_m * 1e6:g} um and {self.depth_offset_m * 1e6:g} um); set one of them to 0"
            )

    @property
    def needs_normals(self) -> bool:
        """Whether a waypoint depends on the surface's normal: by its z, its standoff or the refraction above it."""
        by_standoff = self.standoff_m != 0.0 and self.standoff_along == "normal"
        return self.orientation == "normal" or by_standoff or self.depth_offset_m > 0.0


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Poses of the laser focus over surface points; read-only.

    Attributes:
        poses_oct: Waypoint2oct [N, 4, 4].
        normals: unit normals of the surface into the tissue [N, 3] in the OCT frame; along the beam if nobody asked.
        tilt_limited: whether the normal was tilted further than allowed and the pose is not along it [N].
    """

    poses_oct: NDArray[np.float64]
    normals: NDArray[np.float64]
    tilt_limited: NDArray[np.bool_]


def place_waypoints(field: Field, surface_m: NDArray[np.float64], config: WaypointConfig) -> Waypoints:
    """Put a waypoint on each surface point, or off it as configured.

    Args:
        field: the field, asked for normals where they are needed.
        surface_m: surface points (x, y, z) [N, 3] in the OCT frame, in metres.
        config: which way the waypoints look and how far off they lie.

    Raises:
        PlanError: a normal is tilted beyond the limit and such waypoints are refused.
    """
    surface = np.asarray(surface_m, dtype=np.float64)
    normals = np.broadcast_to(BEAM, surface.shape)
    if config.needs_normals:
        normals = inward_normals(field, surface, config.normal_radius_voxels)
    z, limited = np.broadcast_to(BEAM, surface.shape), np.zeros(len(surface), dtype=np.bool_)
    if config.orientation == "normal":
        z, limited = limit_tilt(normals, math.radians(config.max_tilt_deg))
        if config.beyond_tilt == "refuse" and limited.any():
            first = int(np.argmax(limited))
            x, y = surface[first, :2] * 1e3
            raise PlanError(
                f"expected waypoints tilted by at most {config.max_tilt_deg:g} degrees against the beam, got "
                f"{int(limited.sum())} of {len(limited)} beyond it; waypoint {first} at ({x:.3f}, {y:.3f}) mm needs "
                f"{math.degrees(math.acos(normals[first, 2])):.1f}. Turn the probe to the surface, or limit the tilt"
            )
    off = {"pose": z, "beam": np.broadcast_to(BEAM, surface.shape), "normal": normals}[config.standoff_along]
    focus = surface - config.standoff_m * off
    if config.depth_offset_m > 0.0:
        inside = refract(BEAM, normals, config.refractive_index)
        focus = surface + config.depth_offset_m / config.refractive_index * inside
    return Waypoints(waypoint_poses(focus, z, 0.0), normals, limited)


def limit_tilt(axes: NDArray[np.float64], max_tilt_rad: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Tilt unit vectors [N, 3] with z > 0 back to a largest angle against z, in their own azimuth; tell which [N]."""
    lateral = np.linalg.norm(axes[:, :2], axis=1)
    limited = np.arctan2(lateral, axes[:, 2]) > max_tilt_rad + 1e-9
    towards = axes[:, :2] / np.where(lateral > 0, lateral, 1.0)[:, None]
    tilted = np.column_stack([math.sin(max_tilt_rad) * towards, np.full(len(axes), math.cos(max_tilt_rad))])
    return np.where(limited[:, None], tilted, axes), limited


def refract(
    incident: NDArray[np.float64], normals: NDArray[np.float64], refractive_index: float
) -> NDArray[np.float64]:
    """Return the directions [N, 3] of a beam from air inside the tissue (Snell's law): sin t = sin i / n.

    Args:
        incident: unit direction of the beam in air [3] or [N, 3].
        normals: unit normals of the surface into the tissue [N, 3].
        refractive_index: n of the tissue over that of air, at least 1.
    """
    ratio = 1.0 / refractive_index
    cosine = np.sum(incident * normals, axis=1, keepdims=True)
    inside = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
    return np.asarray(ratio * incident + (inside - ratio * cosine) * normals, dtype=np.float64)


def inward_normals(field: Field, points_m: NDArray[np.floating], radius_voxels: float = 2.0) -> NDArray[np.float64]:
    """Return unit normals of the level set that point into the tissue, from the field's exact gradients.

    A gradient of the field sees single grains of speckle, so it is averaged over 9 places across the beam. Not
    differentiable; thread-safe; any device.

    Args:
        field: the field that is asked.
        points_m: surface points (x, y, z) [N, 3] in the OCT frame, in metres.
        radius_voxels: reach of the 9 places along the lateral and B-scan axes, 0 for the gradient at the point alone.

    Returns:
        Normals [N, 3] in the OCT frame with z > 0; along the beam where the field is flat or falls along it.
    """
    geometry = field.geometry
    index = geometry.metric_to_voxel(np.asarray(points_m, dtype=np.float64))
    total = torch.zeros(len(index), 3, device=field.device)
    steps = (-radius_voxels, 0.0, radius_voxels) if radius_voxels > 0 else (0.0,)
    for bscan, lateral in itertools.product(steps, repeat=2):
        places = geometry.voxel_to_canonical(index + np.array([bscan, 0.0, lateral])).clip(-1.0, 1.0)
        total += field.value_and_gradient(torch.from_numpy(places.astype(np.float32)).to(field.device))[1]
    lateral_m, axial_m, bscan_m = geometry.metres_per_canonical
    by_lateral, by_axial, by_bscan = total.cpu().numpy().astype(np.float64).T
    normal = np.stack([by_lateral / lateral_m, by_bscan / bscan_m, by_axial / axial_m], axis=-1)
    normal[~(normal[:, 2] > 0)] = (0.0, 0.0, 1.0)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def waypoint_poses(
    points_m: NDArray[np.floating], z_axis: NDArray[np.floating], standoff_m: float
) -> NDArray[np.float64]:
    """Return poses with the given z axes, and x kept to the OCT lateral direction as far as z allows.

    Args:
        points_m: surface points (x, y, z) [N, 3] in the OCT frame, in metres.
        z_axis: unit vectors [N, 3] or one [3] into the tissue: the beam (0, 0, 1) or inward normals.
        standoff_m: distance of the focus from the surface, against z; positive lies towards the probe.

    Returns:
        Waypoint2oct [N, 4, 4], float64.

    Raises:
        PlanError: points and axes do not fit, or a z axis does not point into the tissue.
    """
    points = np.asarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or np.shape(z_axis) not in ((3,), points.shape):
        raise PlanError(f"expected points [N, 3] and axes [N, 3] or [3], got {points.shape} and {np.shape(z_axis)}")
    z = np.broadcast_to(np.asarray(z_axis, dtype=np.float64), points.shape)
    if not (z[:, 2] > 0).all():
        bad = int(np.argmin(z[:, 2] > 0))
        raise PlanError(f"expected z axes that point into the tissue (z > 0), got {z[bad].tolist()} at waypoint {bad}")
    # y across z and the lateral direction: always defined, since z is never perpendicular to the beam.
    y = np.stack([np.zeros(len(z)), z[:, 2], -z[:, 1]], axis=-1)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    poses = np.zeros((len(points), 4, 4))
    poses[:, :3, 0] = np.cross(y, z)
    poses[:, :3, 1] = y
    poses[:, :3, 2] = z
    poses[:, :3, 3] = points - standoff_m * z
    poses[:, 3, 3] = 1.0
    return poses
