"""Slices of a field as messages: a grid that lies in space, and the picture in full depth."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import Image

from octn_ros.errors import QueryError
from octn_ros.nodes import conversions
from octn_ros.nodes.field_receiver import ReceivedField
from octn_ros.query import SliceImage, SliceSpec
from octn_ros.volume import VolumeGeometry


class SliceAnswer(NamedTuple):
    """A slice as messages.

    Attributes:
        grid: 101 grey levels in square cells, placed in space.
        image: the values themselves, 32FC1.
        figures: quantity, size, and the values that are grey levels 0 and 100.
    """

    grid: OccupancyGrid
    image: Image
    figures: dict[str, Any]


def answer_slice(received: ReceivedField, spec: SliceSpec, most_pixels: int) -> SliceAnswer:
    """Take a picture of the present field.

    Raises:
        QueryError: it would have too many pixels (nothing is allocated for them), or lies outside the scan.
    """
    pixels = _pixels(spec, received.field.geometry)
    if pixels > most_pixels:
        raise QueryError(
            f"expected a slice of at most {most_pixels:,} pixels (parameter limits.slice_pixels), got {pixels:,}"
        )
    picture = spec.evaluate(received.field)
    levels = _levels(picture)
    grid = conversions.picture_to_grid(
        picture.pixels,
        picture.origin_m,
        picture.along_m,
        picture.down_m,
        received.stamp_ns,
        received.frame,
        levels,
    )
    image = conversions.to_image(picture.pixels, received.stamp_ns, received.frame)
    figures = {
        "slice": picture.specification,
        "quantity": picture.quantity,
        "rows": image.height,
        "columns": image.width,
        "grey_0": levels[0],
        "grey_100": levels[1],
    }
    return SliceAnswer(grid, image, figures)


def _pixels(spec: SliceSpec, geometry: VolumeGeometry) -> int:
    """Return how many pixels a slice at native voxels or in a plane has; other views have limits of their own."""
    bscans, axials, laterals = geometry.shape
    if spec.kind == "plane":
        return math.prod(spec.plane(min(geometry.spacing_m)).shape)
    if spec.kind == "enface" and spec.mode == "depth":
        return 0
    counts = {"bscan": axials * laterals, "axial": bscans * laterals, "lateral": axials * bscans}
    return {**counts, "enface": bscans * laterals}.get(spec.kind, 0)


def _levels(picture: SliceImage) -> tuple[float, float]:
    """Return what becomes grey 0 and 100: the range of an intensity; for depths, the nearest and the farthest."""
    known = picture.pixels[np.isfinite(picture.pixels)]
    if picture.quantity != "depth_m" or not len(known):
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    return low, max(high, low + 1e-9)
