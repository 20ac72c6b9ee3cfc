"""Steps from air to tissue in A-scans: the level that stays bright below a place over the level that is dark above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.field.backend import numba_is_there

# Boxes on either side of a step; a layer has to fill more than one of them to be taken for tissue.
_BOXES = 5
# Share of the height of the highest steps from which one is of tissue, and not of a background without any.
_SUBSTANTIAL = 0.15


def voxels_of_a_box(window: float) -> int:
    """Return the axial voxels of one box, so that all on one side of a step span `window` voxels."""
    return max(1, round(window / _BOXES))


@dataclass(frozen=True, eq=False)
class StepLevels:
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
    def of(cls, ascans: NDArray[np.float32], box: int, lateral: tuple[int, int]) -> StepLevels:
        """Take the levels of A-scans [bscan, lateral, axial], averaged over `lateral` of them, in boxes of `box`."""
        count, pad = ascans.shape[-1], _BOXES * box
        smooth = ndimage.uniform_filter(ascans, size=(*lateral, 1), mode="nearest") if max(lateral) > 1 else ascans
        # Beyond its ends an A-scan goes on at the level of its last box: air above, and tissue below.
        top = np.repeat(smooth[..., :box].mean(axis=-1, keepdims=True), pad, axis=-1)
        bottom = np.repeat(smooth[..., -box:].mean(axis=-1, keepdims=True), pad, axis=-1)
        padded = np.concatenate([top, smooth, bottom], axis=-1)
        total = np.cumsum(padded, axis=-1, dtype=np.float64)
        total = np.concatenate([np.zeros_like(total[..., :1]), total], axis=-1)
        mean = ((total[..., box:] - total[..., :-box]) / box).astype(np.float32)
        boxes = [mean[..., pad + n * box : pad + n * box + count + 1] for n in range(-_BOXES, _BOXES)]
        above, below = _median_of_five(boxes[:_BOXES]), _second_lowest(boxes[_BOXES:])
        step, rise = np.maximum(below - above, 0.0), np.maximum(boxes[_BOXES] - boxes[_BOXES - 1], 0.0)
        near = mean[..., pad - box // 2 : pad - box // 2 + count]
        return cls(above, below, np.sqrt(step * rise), near, box)

    def candidates(self, count: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return the strongest separate places of each A-scan and their strengths, [bscan, lateral, count] each.

        Fewer than `count` in A-scans with fewer places.
        """
        summit = ndimage.maximum_filter1d(self.strength, 4 * self.box + 1, axis=-1, mode="nearest") == self.strength
        peaks = np.where(summit, self.strength, 0.0)
        count = min(count, peaks.shape[-1])
        place = np.argpartition(peaks, -count, axis=-1)[..., -count:]
        return place, np.take_along_axis(peaks, place, axis=-1)

    def at(self, place: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the levels above and below the places [bscan, lateral]."""
        where = place[..., None]
        return np.take_along_axis(self.above, where, -1)[..., 0], np.take_along_axis(self.below, where, -1)[..., 0]

    def crossing(self, place: NDArray[np.intp], level: NDArray[np.float32]) -> NDArray[np.float64]:
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


def strongest_steps(
    ascans: NDArray[np.float32], box: int, lateral: tuple[int, int], count: int
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Return place, strength and air level [bscan, lateral, count] of the strongest separate steps of each A-scan.

    In one compiled pass where numba is installed, else by `strongest_steps_reference`; the order of the steps is not
    defined. Thread-safe.

    Args:
        ascans: A-scans [bscan, lateral, axial].
        box: axial voxels of one box.
        lateral: A-scans that are averaged along (bscan, lateral), odd, or 0 for none.
        count: steps of each A-scan, at most one for each place.
    """
    if not numba_is_there():
        return strongest_steps_reference(ascans, box, lateral, count)
    from octn_ros.planning.step_kernel import strongest_steps_compiled

    return strongest_steps_compiled(ascans, box, lateral, count)


def warm_up_steps() -> None:
    """Compile, or load from the cache, what `strongest_steps` runs, so that no first plan waits for it."""
    strongest_steps(np.zeros((1, 1, 8), dtype=np.float32), 1, (0, 0), 1)


def strongest_steps_reference(
    ascans: NDArray[np.float32], box: int, lateral: tuple[int, int], count: int
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Return what `strongest_steps` does, by way of the levels around every place."""
    levels = StepLevels.of(ascans, box, lateral)
    place, strength = levels.candidates(count)
    return place, strength, np.take_along_axis(levels.above, place, axis=-1)


def substantial(steps: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which steps are as high as those of tissue: tissue may be under a part of the raster only."""
    return steps >= _SUBSTANTIAL * np.percentile(steps, 90)


def usual_step(steps: NDArray[np.floating]) -> float:
    """Return the median of the substantial steps."""
    return float(np.median(steps[substantial(steps)]))


def aligned_steps(
    ascans: NDArray[np.float32], place: NDArray[np.integer], box: int, lateral: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Look at steps again, with neighbours shifted onto each other before they are averaged: slopes blur nothing then.

    Args:
        ascans: A-scans [bscan, lateral, axial].
        place: where the steps are [bscan, lateral], smooth but for cliffs.
        box: axial voxels of one box.
        lateral: neighbours that are averaged along (bscan, lateral), odd.

    Returns:
        Fractional axial index where the A-scan rises through the middle of the step, and the levels above and below
        it, [bscan, lateral] each. The middle is that of a step no higher than the usual one.
    """
    reach = (_BOXES + 2) * box
    index = np.clip(place[..., None] + np.arange(-reach, reach), 0, ascans.shape[-1] - 1)
    windows = np.take_along_axis(ascans, index, axis=-1)
    levels = StepLevels.of(windows, box, lateral)
    around = slice(reach - 2 * box, reach + 2 * box + 1)
    best = levels.strength[..., around].argmax(axis=-1) + around.start
    above, below = levels.at(best)
    step = below - above
    fine = levels.crossing(best, above + 0.5 * np.minimum(step, usual_step(step)))
    return place + (fine - reach), above, below


def _second_lowest(boxes: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    lowest, second = np.minimum(boxes[0], boxes[1]), np.maximum(boxes[0], boxes[1])
    for box in boxes[2:]:
        second = np.minimum(second, np.maximum(lowest, box))
        lowest = np.minimum(lowest, box)
    return second


def _median_of_five(boxes: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    a, b, c, d, e = boxes
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    return np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e))
