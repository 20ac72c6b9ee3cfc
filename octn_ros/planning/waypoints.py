"""Waypoints: poses of the laser focus on the surface."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.errors import PlanError
from octn_ros.field import Field
from octn_ros.settings import check_settings, setting

ORIENTATIONS = ("beam", "normal")


@dataclass(frozen=True)
class WaypointConfig:
    """Where the laser focus lies with respect to the surface, and which way it looks."""

    orientation: str = setting("beam", "z of a waypoint: along the beam or the inward normal", choices=ORIENTATIONS)
    standoff_m: float = setting(
        0.0, "distance of the focus from the surface, against z; positive lies towards the probe", unit="m",
        low=-0.01, high=0.01,
    )  # fmt: skip
    normal_radius_voxels: float = setting(
        2.0, "lateral reach of the gradients that are averaged to a normal", unit="voxels", low=0.0, high=20.0
    )

    def __post_init__(self) -> None:
        check_settings(self)


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
