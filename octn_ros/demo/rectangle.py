"""The rectangle that is planned over when nobody names one."""

from __future__ import annotations

import math

from octn_ros.errors import PlanError
from octn_ros.volume.geometry import VolumeGeometry

LARGEST_SIDE_M = 3e-3  # of the paper's raster
MARGIN_VOXELS = 2.0  # the neighbourhood of the outermost waypoints lies in the field too

Corner = tuple[float, float]


def centred_rectangle(
    geometry: VolumeGeometry, angle_rad: float = 0.0, largest_m: float = LARGEST_SIDE_M
) -> tuple[Corner, Corner]:
    """Return opposite corners (x, y) in metres, OCT frame, of a centred rectangle that fits the scan.

    Unturned it is the largest one; turned, the same one shrunk until it fits.

    Args:
        geometry: of the scan.
        angle_rad: angle of the rectangle's first side against the lateral axis, towards the bscan axis.
        largest_m: its sides are no longer than this, the paper's 3 mm if left out.

    Raises:
        PlanError: the scan is too narrow for any.
    """
    x, y, _ = geometry.origin_m
    width, length, _ = geometry.extent_m
    bscan, _, lateral = geometry.spacing_m
    room_x, room_y = width / 2 - MARGIN_VOXELS * lateral, length / 2 - MARGIN_VOXELS * bscan
    if room_x <= 0 or room_y <= 0:
        raise PlanError(
            f"expected a scan of more than {2 * MARGIN_VOXELS + 1:.0f} B-scans and A-scans per B-scan to plan over, "
            f"got {geometry.shape[0]} and {geometry.shape[2]}"
        )
    if not math.isfinite(angle_rad):
        raise PlanError(f"expected a finite angle of the rectangle, got {angle_rad}")
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    first, second = (min(largest_m / 2, room) for room in (room_x, room_y))
    if abs(sine) > abs(cosine):  # the first side lies nearer to the bscan axis
        first, second = second, first
    shrink = min(
        1.0,
        room_x / (first * abs(cosine) + second * abs(sine)),
        room_y / (first * abs(sine) + second * abs(cosine)),
    )
    half_x, half_y = shrink * (first * cosine - second * sine), shrink * (first * sine + second * cosine)
    centre_x, centre_y = x + width / 2, y + length / 2
    return (centre_x - half_x, centre_y - half_y), (centre_x + half_x, centre_y + half_y)
