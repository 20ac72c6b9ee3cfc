"""How good a run was: the field against what was measured and against the truth, the path against the true surface."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.demo.session import SessionRecord
from octn_ros.demo.source import ScanSource
from octn_ros.field import Field
from octn_ros.metrics import SurfaceDistance, psnr_db, surface_distance
from octn_ros.volume import gaussian_filter

COMPARED_BSCANS = 16  # as in the paper's fig. 7a; all of a large scan would take a minute on two cores
GAUSSIAN_VOXELS = 1.0


@dataclass(frozen=True, eq=False)
class Assessment:
    """The figures that the graph cannot know, and what the pictures need of them.

    Attributes:
        bscans: indices of the B-scans that were compared [K].
        psnr_db: field against the measured voxels.
        psnr_truth_db: field against the noise-free truth, None for a recording.
        gaussian_psnr_truth_db: the measured volume after a Gaussian of one voxel against the truth, None likewise.
        distance: of the waypoints to the true surface, None for a recording.
        depth_error_um: depth of each waypoint minus the true depth [N], None for a recording.
    """

    bscans: NDArray[np.intp]
    psnr_db: float
    psnr_truth_db: float | None
    gaussian_psnr_truth_db: float | None
    distance: SurfaceDistance | None
    depth_error_um: NDArray[np.float64] | None


def assess(source: ScanSource, record: SessionRecord) -> Assessment:
    """Compare a run with what was measured and, for a phantom, with the truth."""
    field, volume = record.field, source.volume
    # The trainer saw raw B-scans and chose their range; the comparison is made in that of the field.
    volume = dataclasses.replace(volume, intensity_range=field.description.intensity_range)
    bscans = evenly_spaced(volume.geometry.shape[0])
    measured, fitted = volume.normalized(), render_bscans(field, bscans)
    psnr_truth = gaussian_psnr_truth = distance = depth_error_um = None
    if source.truth is not None:
        truth = source.truth.normalized()[bscans]
        smoothed = gaussian_filter(volume, GAUSSIAN_VOXELS).normalized()[bscans]
        psnr_truth, gaussian_psnr_truth = psnr_db(truth, fitted), psnr_db(truth, smoothed)
    if source.surface_depth_m is not None:
        points = record.waypoints_oct[:, :3, 3]
        distance = surface_distance(points, source.surface_depth_m)
        depth_error_um = 1e6 * (points[:, 2] - source.surface_depth_m(points[:, 0], points[:, 1]))
    return Assessment(
        bscans=bscans,
        psnr_db=psnr_db(measured[bscans], fitted),
        psnr_truth_db=psnr_truth,
        gaussian_psnr_truth_db=gaussian_psnr_truth,
        distance=distance,
        depth_error_um=depth_error_um,
    )


def evenly_spaced(count: int, largest: int = COMPARED_BSCANS) -> NDArray[np.intp]:
    """Return at most `largest` evenly spaced indices of `count`, the first and the last among them."""
    return np.rint(np.linspace(0, count - 1, min(count, largest))).astype(np.intp)


def render_bscans(field: Field, bscans: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the field at the native voxels of some B-scans, [K, axial, lateral]."""
    counts = field.geometry.shape
    bscan, axial, lateral = (torch.linspace(-1.0, 1.0, count, device=field.device) for count in counts)
    chosen = torch.from_numpy(bscans).to(field.device)
    return field.lattice(lateral, axial, bscan[chosen]).cpu().numpy()
