"""A box of voxels out of a C-scan."""

from __future__ import annotations

import dataclasses

import numpy as np

from octn_ros.errors import VolumeError
from octn_ros.volume.geometry import VolumeGeometry
from octn_ros.volume.orientation import AXES
from octn_ros.volume.volume import Volume

Span = tuple[int, int]


def crop(volume: Volume, bscan: Span | None = None, axial: Span | None = None, lateral: Span | None = None) -> Volume:
    """Return the voxels between the given indices; the origin moves along, so every voxel stays where it was.

    Args:
        volume: the C-scan.
        bscan: first B-scan and the one after the last, None for all.
        axial: likewise for rows.
        lateral: likewise for columns.

    Returns:
        A volume with an array of its own.

    Raises:
        VolumeError: a span lies outside the volume or keeps fewer than two voxels.
    """
    spans = []
    for axis, count, span in zip(AXES, volume.geometry.shape, (bscan, axial, lateral), strict=True):
        start, stop = (0, count) if span is None else span
        if not (start >= 0 and start + 2 <= stop <= count):
            raise VolumeError(
                f"expected at least two {axis} indices START <= i < STOP between 0 and {count}, got {start} to {stop}"
            )
        spans.append((start, stop))
    geometry = VolumeGeometry(
        shape=tuple(stop - start for start, stop in spans),  # type: ignore[arg-type]
        spacing_m=volume.geometry.spacing_m,
        origin_m=tuple(volume.geometry.voxel_to_metric(np.array([start for start, _ in spans], float)).tolist()),
        frame=volume.geometry.frame,
    )
    array = volume.array[tuple(slice(start, stop) for start, stop in spans)]
    return dataclasses.replace(volume, array=array.copy(), geometry=geometry)
