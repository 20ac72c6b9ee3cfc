"""Regions of interest in a B-scan: air, tissue and the boundary between them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import yaml
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.metrics.image import SSIM_WINDOW

RegionKind = Literal["air", "tissue", "boundary"]
_KINDS = get_args(RegionKind)
_KEYS = ("name", "kind", "axial", "lateral")
# Voxels between the surface and a region of air or tissue: the edge itself and its blur belong to neither.
_MARGIN_VOXELS = 6
_SMALLEST_VOXELS = SSIM_WINDOW


@dataclass(frozen=True)
class RegionOfInterest:
    """A rectangle in a B-scan.

    Attributes:
        name: what to call it in tables.
        kind: "air" is the noise of an SNR, "tissue" its signal, "boundary" holds the surface.
        axial: first voxel and the one after the last, along the beam.
        lateral: likewise along the B-scan.

    Raises:
        QueryError: the kind is unknown or a range is empty or negative.
    """

    name: str
    kind: RegionKind
    axial: tuple[int, int]
    lateral: tuple[int, int]

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise QueryError(f"region {self.name!r}: expected the kind {', '.join(_KINDS)}, got {self.kind!r}")
        for axis in ("axial", "lateral"):
            first, last = getattr(self, axis)
            if not 0 <= first < last:
                raise QueryError(
                    f"region {self.name!r}: expected {axis} voxels [first, after the last] with 0 <= first < last, "
                    f"got {[first, last]}"
                )

    def cut(self, bscan: NDArray[Any]) -> NDArray[Any]:
        """Return the region of a B-scan [axial, lateral], a view.

        Raises:
            QueryError: the region does not lie in the B-scan.
        """
        if bscan.ndim != 2 or self.axial[1] > bscan.shape[0] or self.lateral[1] > bscan.shape[1]:
            raise QueryError(
                f"region {self.name!r}: axial {list(self.axial)} and lateral {list(self.lateral)} lie outside the "
                f"B-scan [axial, lateral] of {bscan.shape}"
            )
        region: NDArray[Any] = bscan[self.axial[0] : self.axial[1], self.lateral[0] : self.lateral[1]]
        return region

    def contains(self, axial: NDArray[np.floating], lateral: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Tell which places, in voxels of equal shape, lie in the rectangle."""
        inside: NDArray[np.bool_] = (
            (axial >= self.axial[0])
            & (axial <= self.axial[1] - 1)
            & (lateral >= self.lateral[0])
            & (lateral <= self.lateral[1] - 1)
        )
        return inside


def load_regions(path: str | Path) -> tuple[RegionOfInterest, ...]:
    """Read regions from a YAML or JSON file: a list of {name, kind, axial: [a, b], lateral: [c, d]}, in voxels.

    Raises:
        QueryError: the file is missing or unreadable, or an entry is not a region.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        entries = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, ValueError, yaml.YAMLError) as error:
        raise QueryError(f"{path}: expected regions of interest as YAML or JSON: {error}") from error
    if not isinstance(entries, list) or not entries:
        raise QueryError(f"{path}: expected a list of regions with the keys {', '.join(_KEYS)}")
    try:
        return tuple(_region(entry) for entry in entries)
    except QueryError as error:
        raise QueryError(f"{path}: {error}") from error


def find_regions(surface_voxels: NDArray[np.floating], shape: tuple[int, int]) -> tuple[RegionOfInterest, ...]:
    """Choose one region of each kind from the surface in a B-scan: in its middle half, where there is room.

    Air lies above the surface's highest point there, tissue directly below its lowest, the boundary around all of it.

    Args:
        surface_voxels: axial index of the surface for each lateral voxel [lateral].
        shape: voxels of the B-scan (axial, lateral).

    Returns:
        The regions for which there is room, "air", "tissue" and "boundary" in this order.

    Raises:
        QueryError: the surface does not fit the shape or is not finite.
    """
    axials, laterals = shape
    if surface_voxels.shape != (laterals,) or not np.isfinite(surface_voxels).all():
        raise QueryError(
            f"find_regions: expected a finite surface for {laterals} lateral voxels, got {surface_voxels.shape}"
        )
    columns = laterals // 4, laterals - laterals // 4
    # Single A-scans whose surface went astray must not decide where there is room.
    high, low = np.quantile(surface_voxels[columns[0] : columns[1]], (0.05, 0.95))
    above, below = int(high) - _MARGIN_VOXELS, int(np.ceil(low)) + _MARGIN_VOXELS
    depth = _band_voxels(axials)
    ranges: Sequence[tuple[RegionKind, int, int]] = (
        ("air", max(0, above - depth), above),
        ("tissue", below, min(axials, below + depth)),
        ("boundary", max(0, above), min(axials, below)),
    )
    return tuple(
        RegionOfInterest(kind, kind, (first, last), columns)
        for kind, first, last in ranges
        if last - first >= _SMALLEST_VOXELS
    )


def air_and_tissue(surface_voxels: NDArray[np.floating], axials: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Choose the bands along a surface whose voxels are air and tissue, as thick as the regions of `find_regions`.

    They follow the surface, a few voxels away from it: air above, tissue below. Deeper tissue, where light is lost,
    and the scanner's first rows belong to neither.

    Args:
        surface_voxels: axial index of the surface [..., lateral].
        axials: voxels along the beam.

    Returns:
        Masks of air and tissue [..., axial, lateral].
    """
    below = np.arange(axials)[:, None] - surface_voxels[..., None, :]
    thick = _MARGIN_VOXELS + _band_voxels(axials)
    return (below < -_MARGIN_VOXELS) & (below >= -thick), (below > _MARGIN_VOXELS) & (below <= thick)


def _band_voxels(axials: int) -> int:
    return max(_SMALLEST_VOXELS, axials // 8)


def _region(entry: Any) -> RegionOfInterest:
    if not isinstance(entry, dict) or set(entry) != set(_KEYS):
        raise QueryError(f"expected a region with the keys {', '.join(_KEYS)}, got {entry!r}")
    pairs = []
    for axis in ("axial", "lateral"):
        pair = entry[axis]
        if not isinstance(pair, list) or len(pair) != 2 or not all(type(value) is int for value in pair):
            raise QueryError(f"region {entry['name']!r}: expected {axis} as two whole voxel numbers, got {pair!r}")
        pairs.append((pair[0], pair[1]))
    return RegionOfInterest(str(entry["name"]), entry["kind"], pairs[0], pairs[1])
