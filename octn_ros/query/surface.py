"""The tissue surface on a lattice of A-scans, by the largest axial gradient (eq. 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.query.lattice import canonical_index, lattice_size
from octn_ros.settings import check_settings, setting

# A rise of the displayed intensity below this per voxel is rounding, not a surface.
_SMALLEST_RISE = 1e-6
# A rise near the neighbours' depth counts as the surface from this share of the scan's usual one.
_WEAKEST_EDGE = 0.25


@dataclass(frozen=True)
class SurfaceMapConfig:
    """How the surface is looked for."""

    max_ascans: int = setting(4096, "largest number of A-scans that are searched", low=4, high=4_194_304)
    axial_sigma_voxels: float = setting(
        1.0, "Gaussian over each A-scan before its gradient is taken, 0 for none", unit="voxels", low=0.0, high=10.0
    )
    consensus_ascans: int = setting(
        5, "side of the window of A-scans whose median depth an A-scan is held against, 1 for none", low=1, high=31
    )
    consensus_sigma_ascans: float = setting(
        2.0,
        "Gaussian over neighbouring A-scans before that median is taken, at most as wide as consensus_voxels are deep; "
        "0 for none",
        low=0.0,
        high=31.0,
    )
    consensus_voxels: float = setting(
        5.0, "an A-scan further than this from the median is searched again within it", unit="voxels", low=1.0
    )

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def method(self) -> str:
        """The search in words, to be named with every result."""
        words = ["largest axial rise"]
        if self.axial_sigma_voxels > 0:
            words.append(f"after an axial Gaussian of {self.axial_sigma_voxels:g} voxel")
        if self.consensus_ascans > 1:
            words.append(f"within {self.consensus_voxels:g} voxels of the median of {self.consensus_ascans}^2 A-scans")
            if self.consensus_sigma_ascans > 0:
                words.append(f"after a Gaussian over up to {self.consensus_sigma_ascans:g} of them")
        return " ".join(words)


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """The surface over a lattice of A-scans; read-only.

    Attributes:
        depth_m: axial depth z of the surface [bscan, lateral] in the OCT frame, in metres, finer than a voxel.
        intensity: the field's own intensity at the surface [bscan, lateral].
        confidence: 1 minus the ratio of the largest rise elsewhere in the A-scan to the surface's own [bscan, lateral];
            0 where another place in the depth rises as steeply.
        lateral_m: x of the columns [lateral] in the OCT frame.
        bscan_m: y of the rows [bscan] in the OCT frame.
    """

    depth_m: NDArray[np.float64]
    intensity: NDArray[np.float32]
    confidence: NDArray[np.float32]
    lateral_m: NDArray[np.float64]
    bscan_m: NDArray[np.float64]

    def sample(self, values: NDArray[np.floating], points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Interpolate one of the map's arrays bilinearly at lateral places.

        Args:
            values: array [bscan, lateral] over the map's lattice.
            points_m: (x, y) [N, 2] in the OCT frame; outside the lattice the nearest place on its edge counts.

        Returns:
            Values [N].
        """
        column = (points_m[:, 0] - self.lateral_m[0]) / (self.lateral_m[1] - self.lateral_m[0])
        row = (points_m[:, 1] - self.bscan_m[0]) / (self.bscan_m[1] - self.bscan_m[0])
        return ndimage.map_coordinates(values.astype(np.float64), [row, column], order=1, mode="nearest")


def surface_map(
    field: Field,
    config: SurfaceMapConfig | None = None,
    *,
    lateral_range_m: tuple[float, float] | None = None,
    bscan_range_m: tuple[float, float] | None = None,
) -> SurfaceMap:
    """Find the surface in a lattice of A-scans (eq. 3).

    The paper takes the largest |gradient|. The air-tissue interface is where intensity rises along the beam, so falls
    do not count here. The argmax picks speckle where it is steeper than the edge; an A-scan whose depth is not that
    of its neighbours is therefore searched again near theirs. Takes some 24 bytes of memory for each point that is
    searched (A-scans times axial voxels). Not differentiable; thread-safe; any device.

    Args:
        field: the field that is searched, at every axial voxel of each A-scan.
        config: how; the defaults if left out.
        lateral_range_m: first and last x of the lattice in the OCT frame, the whole field if left out; clipped to it.
        bscan_range_m: first and last y of the lattice, likewise.

    Raises:
        QueryError: a range is empty or outside the field, or nothing in the field rises along the beam.
    """
    config = config or SurfaceMapConfig()
    geometry = field.geometry
    bscans, axials, laterals = geometry.shape
    lateral = _index_range("lateral_range_m", lateral_range_m, geometry.origin_m[0], geometry.spacing_m[2], laterals)
    bscan = _index_range("bscan_range_m", bscan_range_m, geometry.origin_m[1], geometry.spacing_m[0], bscans)
    columns, rows = lattice_size(
        (lateral[1] - lateral[0]) * geometry.spacing_m[2],
        (bscan[1] - bscan[0]) * geometry.spacing_m[0],
        (math.ceil(lateral[1] - lateral[0] - 1e-6) + 1, math.ceil(bscan[1] - bscan[0] - 1e-6) + 1),
        config.max_ascans,
    )
    lateral_index, bscan_index = np.linspace(*lateral, columns), np.linspace(*bscan, rows)
    profiles = field.lattice(
        canonical_index(lateral_index, laterals, field.device),
        canonical_index(np.arange(axials), axials, field.device),
        canonical_index(bscan_index, bscans, field.device),
    )
    steps_m = (
        (bscan_index[1] - bscan_index[0]) * geometry.spacing_m[0],
        (lateral_index[1] - lateral_index[0]) * geometry.spacing_m[2],
    )
    # Over a wider way a slope of 45 degrees would leave the consensus, and the Gaussian would blur it away.
    widest_m = config.consensus_voxels * geometry.spacing_m[1]
    row_sigma, column_sigma = (min(config.consensus_sigma_ascans, widest_m / step) for step in steps_m)
    depth_index, confidence = _largest_rise(profiles.cpu().numpy(), config, (row_sigma, column_sigma))
    index = np.stack(np.broadcast_arrays(bscan_index[:, None], depth_index, lateral_index[None, :]), axis=-1)
    points = geometry.voxel_to_canonical(index).reshape(-1, 3).astype(np.float32)
    with torch.no_grad():
        intensity = torch.cat(
            [field.evaluate(part) for part in torch.from_numpy(points).to(field.device).split(1 << 16)]
        )
    metres = geometry.voxel_to_metric(index)
    return SurfaceMap(
        depth_m=np.ascontiguousarray(metres[..., 2]),
        intensity=intensity.cpu().numpy().reshape(depth_index.shape),
        confidence=confidence.astype(np.float32),
        lateral_m=np.ascontiguousarray(metres[0, :, 0]),
        bscan_m=np.ascontiguousarray(metres[:, 0, 1]),
    )


def surface_intensity(surface: SurfaceMap) -> float:
    """Return tau, the median intensity of the surface points, as the paper estimates it (eq. 7)."""
    return float(np.median(surface.intensity))


def _index_range(
    name: str, range_m: tuple[float, float] | None, origin_m: float, spacing_m: float, count: int
) -> tuple[float, float]:
    if range_m is None:
        return 0.0, float(count - 1)
    first, last = ((value - origin_m) / spacing_m for value in range_m)
    clipped = max(first, 0.0), min(last, count - 1.0)
    if not clipped[0] < clipped[1]:
        inside = origin_m * 1e3, (origin_m + (count - 1) * spacing_m) * 1e3
        raise QueryError(
            f"surface_map: expected {name} with first < last that overlaps {inside[0]:.3f} to {inside[1]:.3f} mm, "
            f"got {range_m[0] * 1e3:.3f} to {range_m[1] * 1e3:.3f} mm"
        )
    return clipped


def _largest_rise(
    profiles: NDArray[np.float32], config: SurfaceMapConfig, sigma_ascans: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Find the surface in profiles [bscan, axial, lateral]: fractional axial index and confidence [bscan, lateral]."""
    if config.axial_sigma_voxels > 0:
        profiles = ndimage.gaussian_filter1d(profiles, config.axial_sigma_voxels, axis=1, mode="nearest")
    rise = np.moveaxis(np.gradient(profiles, axis=1), 1, -1)
    best = np.argmax(rise, axis=-1)
    depth = np.arange(rise.shape[-1])
    if config.consensus_ascans > 1:
        _follow_neighbours(best, rise, config, sigma_ascans)
    peak = np.take_along_axis(rise, best[..., None], axis=-1)
    if not np.max(peak) > _SMALLEST_RISE:
        raise QueryError(
            "surface_map: expected a field whose intensity rises along the beam somewhere, got one that never does; "
            "is the axial axis upside down?"
        )
    # The edge itself is as wide as the filter that was laid over it, so a rival must lie outside its foot.
    foot = math.ceil(3 * config.axial_sigma_voxels) + 1
    rival = np.max(np.where(np.abs(depth - best[..., None]) > foot, rise, 0.0), axis=-1)
    confidence = np.clip(1.0 - rival / np.maximum(peak[..., 0], _SMALLEST_RISE), 0.0, 1.0)
    return best + _parabola_vertex(rise, best), confidence


def _follow_neighbours(
    best: NDArray[np.intp], rise: NDArray[np.float32], config: SurfaceMapConfig, sigma_ascans: tuple[float, float]
) -> None:
    """Move, in place, A-scans far from the median of their neighbours to the largest rise near it, if one is there."""
    typical = np.median(np.max(rise, axis=-1))
    agreed = best
    if config.consensus_sigma_ascans > 0:
        # Speckle of neighbouring A-scans averages out where the surface's rise, common to them, does not.
        steady = ndimage.gaussian_filter(rise, sigma_ascans, axes=(0, 1), mode="nearest")
        agreed = np.argmax(steady, axis=-1)
    agreed = ndimage.median_filter(agreed, size=config.consensus_ascans, mode="nearest")
    rows, columns = np.nonzero(np.abs(best - agreed) > config.consensus_voxels)
    profile, median = rise[rows, columns], agreed[rows, columns, None]
    near = np.abs(np.arange(rise.shape[-1]) - median) <= config.consensus_voxels
    # On a steep slope the window may hold only the flank of the true edge: then its largest rise is no summit.
    summit = (profile >= np.roll(profile, 1, axis=-1)) & (profile >= np.roll(profile, -1, axis=-1))
    rival = np.where(near & summit & (profile >= _WEAKEST_EDGE * typical), profile, -np.inf)
    nearer = np.argmax(rival, axis=-1)
    there = np.isfinite(np.max(rival, axis=-1))
    best[rows[there], columns[there]] = nearer[there]


def _parabola_vertex(rise: NDArray[np.float32], best: NDArray[np.intp]) -> NDArray[np.float64]:
    """Offset of the vertex through three samples around each maximum, in voxels, at most half a voxel."""
    centre = np.clip(best, 1, rise.shape[-1] - 2)
    before, at, after = (
        np.take_along_axis(rise, (centre + step)[..., None], axis=-1)[..., 0].astype(np.float64) for step in (-1, 0, 1)
    )
    bend = before - 2.0 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = 0.5 * (before - after) / bend
    # No maximum in the middle (an end of the A-scan, a plateau, a slope cut off by the consensus): stay on the voxel.
    return np.where((bend < 0) & (np.abs(offset) <= 0.5) & (centre == best), offset, 0.0)
