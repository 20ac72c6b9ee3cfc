"""The coarse surface under a raster: where A-scans step from air to tissue, agreed upon by neighbours (eq. 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.errors import PlanError
from octn_ros.field import Field
from octn_ros.planning.candidate_choice import choose_smooth
from octn_ros.settings import check_settings, setting

# Boxes on either side of a step; a layer has to fill more than two of them to be taken for tissue.
_BOXES = 5
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
        250e-6, "side of the square of neighbouring A-scans whose steps are averaged", unit="m", low=0.0, high=5e-3
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
        clearness: 1 minus the strength of the best step above it as a share of its own, 0 to 1. (A step below it is one
            inside the tissue.)
        air: level above the step.
        tissue: level below the step.
        lateral_m: x of the columns [lateral] in the OCT frame.
        bscan_m: y of the rows [bscan].
        typical_step: median height of the steps.
    """

    depth: NDArray[np.float64]
    step: NDArray[np.float32]
    clearness: NDArray[np.float32]
    air: NDArray[np.float32]
    tissue: NDArray[np.float32]
    lateral_m: NDArray[np.float64]
    bscan_m: NDArray[np.float64]
    typical_step: float

    def sample(self, values: NDArray[np.floating], points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Interpolate one of the arrays bilinearly at lateral places (x, y) [N, 2]; beyond the lattice, its edge."""
        return ndimage.map_coordinates(values.astype(np.float64), self._index(points_m), order=1, mode="nearest")

    def nearest(self, values: NDArray[np.floating], points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Take one of the arrays from the nearest A-scan to lateral places (x, y) [N, 2]."""
        return ndimage.map_coordinates(values.astype(np.float64), self._index(points_m), order=0, mode="nearest")

    def depth_at(self, points_m: NDArray[np.floating], spread: float) -> NDArray[np.float64]:
        """Depth in axial voxels at lateral places: interpolated, but not across an edge higher than `spread` voxels."""
        near = self.nearest(self.depth, points_m)
        between = self.sample(self.depth, points_m)
        return np.where(np.abs(between - near) > spread, near, between)

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
    columns, rows = _lattice_size((high - low) * spacing, np.ceil(high - low).astype(int) + 1, config.max_ascans)
    column, row = np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows)
    profiles = field.lattice(
        _canonical(column, laterals, field.device),
        _canonical(np.arange(axials), axials, field.device),
        _canonical(row, bscans, field.device),
    )
    ascans = np.ascontiguousarray(np.moveaxis(profiles.cpu().numpy(), 1, 2))
    pitch_m = (high - low) * spacing / np.array([columns - 1, rows - 1])
    window = _odd(config.lateral_window_m / pitch_m[1], rows), _odd(config.lateral_window_m / pitch_m[0], columns)

    levels = _Levels.of(ascans, config.window_m / geometry.spacing_m[1], window)
    place, strength = levels.candidates(config.candidates)
    strongest = np.take_along_axis(place, strength.argmax(axis=-1)[..., None], axis=-1)
    usual_air = np.median(np.take_along_axis(levels.above, strongest, axis=-1))
    usual = max(float(np.median(strength.max(axis=-1))), _SMALLEST_STEP)
    # Where it is brighter above than air is, a step is one inside the tissue, or there is glare.
    bright = (np.take_along_axis(levels.above, place, axis=-1) - usual_air) / usual
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
    rivals = np.where(place < depth[..., None], strength, 0.0).max(axis=-1)
    above, below = levels.at(depth)
    typical_step = float(np.median(below - above))
    return CoarseSurface(
        depth=levels.middle(depth, above + 0.5 * np.minimum(below - above, typical_step)),
        step=(below - above).astype(np.float32),
        clearness=np.clip(1.0 - rivals / np.maximum(own, _SMALLEST_STEP), 0.0, 1.0).astype(np.float32),
        air=above,
        tissue=below,
        lateral_m=geometry.origin_m[0] + column * geometry.spacing_m[2],
        bscan_m=geometry.origin_m[1] + row * geometry.spacing_m[0],
        typical_step=typical_step,
    )


@dataclass(frozen=True, eq=False)
class _Levels:
    """Levels around every place between two voxels of A-scans, all [bscan, lateral, axial + 1].

    Place k lies before voxel k, at the axial index k - 0.5.

    Attributes:
        above: level of the air above the place.
        below: level of the tissue below it.
        strength: how much of a step lies there, a level: large only where the intensity rises and stays.
        near: mean of one box centred on each voxel [bscan, lateral, axial].
        box: axial voxels of one box.
    """

    above: NDArray[np.float32]
    below: NDArray[np.float32]
    strength: NDArray[np.float32]
    near: NDArray[np.float32]
    box: int

    @classmethod
    def of(cls, ascans: NDArray[np.float32], window: float, lateral: tuple[int, int]) -> _Levels:
        """Take the levels of A-scans [bscan, lateral, axial], averaged over `lateral` of them, `window` voxels wide."""
        box, count = max(1, round(window / _BOXES)), ascans.shape[-1]
        pad = _BOXES * box
        smooth = ndimage.uniform_filter(ascans, size=(*lateral, 1), mode="nearest") if max(lateral) > 1 else ascans
        # Beyond its ends an A-scan goes on at the level of its last box: air above, and tissue below.
        top = np.repeat(smooth[..., :box].mean(axis=-1, keepdims=True), pad, axis=-1)
        bottom = np.repeat(smooth[..., -box:].mean(axis=-1, keepdims=True), pad, axis=-1)
        padded = np.concatenate([top, smooth, bottom], axis=-1)
        total = np.cumsum(padded, axis=-1, dtype=np.float64)
        total = np.concatenate([np.zeros_like(total[..., :1]), total], axis=-1)
        mean = ((total[..., box:] - total[..., :-box]) / box).astype(np.float32)
        boxes = [mean[..., pad + n * box : pad + n * box + count + 1] for n in range(-_BOXES, _BOXES)]
        above, below = _ranked(boxes[:_BOXES], _BOXES // 2), _ranked(boxes[_BOXES:], 1)
        step, rise = np.maximum(below - above, 0.0), np.maximum(boxes[_BOXES] - boxes[_BOXES - 1], 0.0)
        near = mean[..., pad - box // 2 : pad - box // 2 + count]
        return cls(above, below, np.sqrt(step * rise), near, box)

    def candidates(self, count: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return the `count` strongest separate places of each A-scan and their strengths [bscan, lateral, count]."""
        summit = ndimage.maximum_filter1d(self.strength, 4 * self.box + 1, axis=-1, mode="nearest") == self.strength
        peaks = np.where(summit, self.strength, 0.0)
        place = np.argpartition(peaks, -count, axis=-1)[..., -count:]
        return place, np.take_along_axis(peaks, place, axis=-1)

    def at(self, place: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the levels above and below the places [bscan, lateral]."""
        where = place[..., None]
        return np.take_along_axis(self.above, where, -1)[..., 0], np.take_along_axis(self.below, where, -1)[..., 0]

    def middle(self, place: NDArray[np.intp], level: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the fractional voxel index [bscan, lateral] where the level is passed upwards, nearest to the places.

        Looked for within two boxes; where there is none, the place itself.
        """
        reach = 2 * self.box
        index = np.clip(place[..., None] + np.arange(-reach, reach), 0, self.near.shape[-1] - 1)
        excess = np.take_along_axis(self.near, index, axis=-1) - level[..., None]
        before, after = excess[..., :-1], excess[..., 1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = index[..., :-1] + before / (before - after)
        # With boxes of an even number of voxels the middle of a box lies half a voxel before its index.
        crossing -= 0.0 if self.box % 2 else 0.5
        distance = np.where((before < 0) & (after >= 0), np.abs(crossing - (place[..., None] - 0.5)), np.inf)
        nearest = distance.argmin(axis=-1)[..., None]
        found = np.isfinite(np.take_along_axis(distance, nearest, axis=-1)[..., 0])
        return np.where(found, np.take_along_axis(crossing, nearest, axis=-1)[..., 0], place - 0.5)


def _ranked(boxes: list[NDArray[np.float32]], rank: int) -> NDArray[np.float32]:
    return np.partition(np.stack(boxes, axis=-1), rank, axis=-1)[..., rank]


def _lattice_size(side_m: NDArray[np.float64], voxels: NDArray[np.int_], most: int) -> tuple[int, int]:
    """Choose columns and rows of about equal pitch in metres, no finer than the voxels and at most `most` together."""
    columns, rows = max(int(voxels[0]), 2), max(int(voxels[1]), 2)
    if columns * rows <= most:
        return columns, rows
    wanted = min(max(round(math.sqrt(most * side_m[0] / side_m[1])), 2), columns, most // 2)
    rows = min(max(most // wanted, 2), rows)
    return min(columns, max(most // rows, 2)), rows


def _odd(size: float, most: int) -> int:
    count = max(1, min(round(size), most))
    return count if count % 2 else count + 1


def _canonical(index: NDArray[np.number], count: int, device: torch.device) -> torch.Tensor:
    return torch.from_numpy((index * (2.0 / (count - 1)) - 1.0).astype(np.float32)).to(device)
