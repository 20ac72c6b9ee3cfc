"""The coarse surface under a raster: where A-scans step from air to tissue, agreed upon by neighbours (eq. 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.errors import PlanError
from octn_ros.field import Field
from octn_ros.planning.candidate_choice import choose_smooth
from octn_ros.planning.step_levels import aligned_steps, strongest_steps, usual_step, voxels_of_a_box
from octn_ros.query.lattice import canonical_index, lattice_size
from octn_ros.settings import check_settings, setting

# Neighbours are shifted onto each other by their depths, from which better depths follow.
_ALIGNMENTS = 2
# A step counts from this share of the strongest in its A-scan.
_CREDIBLE = 0.35
# Distance between the interpolated depth and the nearest A-scan's own plane from which a cliff lies between them.
_CLIFF_M = 44e-6
# Percentile of the levels above the steps that is that of air: of most A-scans the top may lie in the tissue.
_AIR_PERCENTILE = 10
# Brightness over that of air, as a share of the usual step, below which a step rises from air.
_AIR_AGAIN = 0.5
# A step below this is rounding, not a surface.
_SMALLEST_STEP = 1e-6


@dataclass(frozen=True)
class CoarseSurfaceConfig:
    """How the coarse surface is looked for."""

    max_ascans: int = setting(1024, "largest number of A-scans that are searched", low=4, high=4_194_304)
    window_m: float = setting(
        220e-6, "how far above and below a step its levels are taken", unit="m", low=1e-6, high=5e-3
    )
    lateral_window_m: float = setting(
        150e-6, "side of the square of neighbouring A-scans whose steps are averaged", unit="m", low=0.0, high=5e-3
    )
    candidates: int = setting(4, "steps of each A-scan among which its neighbours decide", low=1, high=32)
    smoothness: float = setting(
        0.4, "cost of a slope of 1 between neighbours, as a share of the usual step", low=0.0, high=10.0
    )

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def method(self) -> str:
        """The search in words, to be named with every result."""
        return (
            f"coarse search by the step between the levels {self.window_m * 1e6:.0f} um above and below, averaged "
            f"over {self.lateral_window_m * 1e6:.0f} um and chosen smoothly among {self.candidates} per A-scan"
        )


@dataclass(frozen=True, eq=False)
class CoarseSurface:
    """The coarse surface over a lattice of A-scans; read-only, all arrays [bscan, lateral].

    Attributes:
        depth: fractional axial voxel index where the averaged A-scan rises through the middle of the step.
        step: its height, the level below it less the level above it.
        clearness: 1 minus the strength of its best rival as a share of its own, 0 to 1. A step above it is a rival; one
            below it is one inside the tissue, unless it rises from air again below a step right under the first row,
            where scanners show bright bands of their own.
        air: level above the step.
        tissue: level below the step.
        lateral_m: x of the columns [lateral] in the OCT frame.
        bscan_m: y of the rows [bscan].
        typical_step: median height of the steps of tissue.
        typical_air: level of the air.
        axial_m: metres of an axial voxel.
    """

    depth: NDArray[np.float64]
    step: NDArray[np.float32]
    clearness: NDArray[np.float32]
    air: NDArray[np.float32]
    tissue: NDArray[np.float32]
    lateral_m: NDArray[np.float64]
    bscan_m: NDArray[np.float64]
    typical_step: float
    typical_air: float
    axial_m: float

    def sample(self, values: NDArray[np.floating], points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Interpolate one of the arrays bilinearly at lateral places (x, y) [N, 2]; beyond the lattice, its edge."""
        return ndimage.map_coordinates(values.astype(np.float64), self._index(points_m), order=1, mode="nearest")

    def depth_at(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Depth in axial voxels at lateral places (x, y) [N, 2]: interpolated, but not across a cliff.

        A cliff lies where the interpolated depth is far from the nearest A-scan's own plane, whose slopes are the
        gentler ones of its two sides (minmod): on a steep slope both sides agree, beside a cliff one is left out.
        """
        row, column = self._index(points_m)
        nearest = tuple(
            np.clip(np.rint(place), 0, count - 1).astype(np.intp)
            for place, count in zip((row, column), self.depth.shape, strict=True)
        )
        plane = self.depth[nearest]
        for axis, place in enumerate((row, column)):
            # Beyond the lattice its edge counts, as in `sample`.
            offset = np.clip(place, 0, self.depth.shape[axis] - 1) - nearest[axis]
            plane = plane + _gentler_step(self.depth, axis)[nearest] * offset
        between = self.sample(self.depth, points_m)
        return np.where(np.abs(between - plane) * self.axial_m > _CLIFF_M, plane, between)

    def slope_at(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the slope in axial voxels per metre along (lateral, bscan) at lateral places [N, 2]."""
        smooth = ndimage.median_filter(self.depth, size=3, mode="nearest")
        across, along = np.gradient(smooth, self.bscan_m, self.lateral_m)
        return np.column_stack([self.sample(along, points_m), self.sample(across, points_m)])

    def _index(self, points_m: NDArray[np.floating]) -> list[NDArray[np.float64]]:
        return [
            (points_m[:, 1] - self.bscan_m[0]) / (self.bscan_m[1] - self.bscan_m[0]),
            (points_m[:, 0] - self.lateral_m[0]) / (self.lateral_m[1] - self.lateral_m[0]),
        ]


def coarse_surface(field: Field, points_m: NDArray[np.float64], config: CoarseSurfaceConfig) -> CoarseSurface:
    """Search a lattice of A-scans over lateral points for the step from air to tissue.

    An argmax of the gradient (eq. 8) finds speckle, a detached layer or a bright streak where those are steeper than
    the tissue. Here a step counts by the level of the tissue that stays bright below it and of the air that stays dark
    above it, order statistics of boxes, so that a thin layer has none; neighbours are averaged, and the smoothest
    choice among the candidates of all A-scans is taken, breaks allowed. Thread-safe; any device.

    Args:
        field: the field, asked at every axial voxel of each A-scan.
        points_m: raster points (x, y) [N, 2] in the OCT frame, inside the field.
        config: how.

    Raises:
        PlanError: nothing in the field rises along the beam.
    """
    geometry = field.geometry
    bscans, axials, laterals = geometry.shape
    spacing = np.array([geometry.spacing_m[2], geometry.spacing_m[0]])
    index = (points_m - np.array(geometry.origin_m[:2])) / spacing
    # The border of the raster needs neighbours too.
    margin = max(config.lateral_window_m, 2.0 * float(spacing.max())) / spacing
    last = np.array([laterals, bscans]) - 1.0
    low, high = np.maximum(index.min(axis=0) - margin, 0.0), np.minimum(index.max(axis=0) + margin, last)
    width_m, height_m = (high - low) * spacing
    voxels = math.ceil(high[0] - low[0]) + 1, math.ceil(high[1] - low[1]) + 1
    columns, rows = lattice_size(width_m, height_m, voxels, config.max_ascans)
    column, row = np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows)
    profiles = field.lattice(
        canonical_index(column, laterals, field.device),
        canonical_index(np.arange(axials), axials, field.device),
        canonical_index(row, bscans, field.device),
    )
    ascans = np.ascontiguousarray(np.moveaxis(profiles.cpu().numpy(), 1, 2))
    pitch_m = (high - low) * spacing / np.array([columns - 1, rows - 1])
    window = _odd(config.lateral_window_m / pitch_m[1], rows), _odd(config.lateral_window_m / pitch_m[0], columns)

    box = voxels_of_a_box(config.window_m / geometry.spacing_m[1])
    place, strength, air = strongest_steps(ascans, box, window, config.candidates)
    # Air is what lies above the first step that counts, whatever is brighter in the depth.
    counts = strength >= _CREDIBLE * strength.max(axis=-1, keepdims=True)
    first = np.where(counts, place, ascans.shape[-1]).argmin(axis=-1)[..., None]
    usual_air = np.percentile(np.take_along_axis(air, first, axis=-1), _AIR_PERCENTILE)
    usual = max(usual_step(np.take_along_axis(strength, first, axis=-1)), _SMALLEST_STEP)
    # Where it is brighter above than air is, a step is one inside the tissue, or there is glare.
    bright = (air - usual_air) / usual
    from_air = np.where(bright < _AIR_AGAIN, strength, 0.0)
    strength = strength * np.clip(1.0 - bright, 0.0, 1.0)
    if not strength.max() > _SMALLEST_STEP:
        raise PlanError(
            "no surface to plan on: expected a field whose intensity rises along the beam somewhere, got one that "
            "never does; is the axial axis upside down?"
        )
    slope_per_voxel = geometry.spacing_m[1] / pitch_m[1], geometry.spacing_m[1] / pitch_m[0]
    chosen = choose_smooth(place, strength / usual, slope_per_voxel, config.smoothness)
    depth = np.take_along_axis(place, chosen[..., None], axis=-1)[..., 0]
    own = np.take_along_axis(strength, chosen[..., None], axis=-1)[..., 0]
    found = depth[..., None]
    again = (place > found + 2 * box) & (found * geometry.spacing_m[1] < config.window_m)
    rivals = np.where(place < found, strength, np.where(again, from_air, 0.0)).max(axis=-1)
    fine = depth.astype(np.float64)
    for _ in range(_ALIGNMENTS):
        # An A-scan that lies off its neighbours is looked at where they are; the others keep crests and cliffs sharp.
        agreed = ndimage.median_filter(fine, 3, mode="nearest")
        place = np.rint(np.where(np.abs(fine - agreed) > box, agreed, fine)).astype(np.intp)
        fine, above, below = aligned_steps(ascans, place, box, window)
    return CoarseSurface(
        depth=fine,
        step=(below - above).astype(np.float32),
        clearness=np.clip(1.0 - rivals / np.maximum(own, _SMALLEST_STEP), 0.0, 1.0).astype(np.float32),
        air=above,
        tissue=below,
        lateral_m=geometry.origin_m[0] + column * geometry.spacing_m[2],
        bscan_m=geometry.origin_m[1] + row * geometry.spacing_m[0],
        typical_step=usual_step(below - above),
        typical_air=float(np.percentile(above, _AIR_PERCENTILE)),
        axial_m=geometry.spacing_m[1],
    )


def _gentler_step(depth: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the step to the next A-scan along an axis: the smaller of the two sides', 0 where their signs differ.

    At an end of the lattice that of the one side there is.
    """
    step = np.diff(depth, axis=axis)
    ends = [step.take([index], axis=axis) for index in (0, -1)]
    before, after = np.concatenate([ends[0], step], axis=axis), np.concatenate([step, ends[1]], axis=axis)
    gentler = np.where(np.abs(before) < np.abs(after), before, after)
    return np.where(before * after > 0, gentler, 0.0)


def _odd(size: float, most: int) -> int:
    """Return an odd number of A-scans about `size`: a neighbour on either side at least, if any are asked for."""
    count = 0 if size == 0 else max(3, min(round(size), most))
    return count if count % 2 else count + 1
