"""Where a C-scan lies: voxel indices, canonical coordinates and metres, and the maps between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError

if TYPE_CHECKING:
    import torch

# The maps work alike on NumPy arrays and torch tensors, without importing torch here.
Points = TypeVar("Points", "NDArray[np.floating]", "torch.Tensor")

OCT_FRAME = "oct_optical_frame"
_SAME_SPACING = 1e-3  # relative: less than a voxel over a whole axis, more than what files round a spacing to
# Axis orders. Arrays and voxel indices: [bscan, axial, lateral]. Canonical coordinates, as the paper's (x, y, z)
# over (W, H, D): (lateral, axial, bscan). OCT frame (REP-103, optical): (lateral, bscan, axial).


@dataclass(frozen=True)
class VolumeGeometry:
    """Shape and place of a C-scan in space; immutable and thread-safe.

    Attributes:
        shape: number of voxels along (bscan, axial, lateral), at least 2 each.
        spacing_m: metres between voxel centres along (bscan, axial, lateral).
        origin_m: centre of voxel (0, 0, 0) in `frame`, as (lateral, bscan, axial) = (x, y, z) in metres.
        frame: name of the right-handed frame whose x is lateral, y bscan and z axial into the tissue.

    Raises:
        VolumeError: an axis is too short, or spacing or origin are not finite positive numbers.
    """

    shape: tuple[int, int, int]
    spacing_m: tuple[float, float, float]
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame: str = OCT_FRAME

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or any(n < 2 for n in self.shape):
            raise VolumeError(f"expected at least 2 voxels along (bscan, axial, lateral), got shape {self.shape}")
        if len(self.spacing_m) != 3 or not all(math.isfinite(s) and s > 0 for s in self.spacing_m):
            raise VolumeError(
                "expected three positive spacings along (bscan, axial, lateral), "
                f"got {tuple(s * 1e6 for s in self.spacing_m)} um"
            )
        if len(self.origin_m) != 3 or not all(math.isfinite(o) for o in self.origin_m):
            raise VolumeError(f"expected three finite origin coordinates in metres, got {self.origin_m}")

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """Distance between the first and last voxel centres along (lateral, bscan, axial) = (x, y, z)."""
        (bscans, axials, laterals), (d, h, w) = self.shape, self.spacing_m
        return (laterals - 1) * w, (bscans - 1) * d, (axials - 1) * h

    def voxel_to_metric(self, index: Points) -> Points:
        """Map voxel indices [..., (bscan, axial, lateral)] to metres [..., (x, y, z)] in `frame`; differentiable."""
        (d, h, w), (x, y, z) = self.spacing_m, self.origin_m
        return _stack(index, index[..., 2] * w + x, index[..., 0] * d + y, index[..., 1] * h + z)

    def metric_to_voxel(self, point_m: Points) -> Points:
        """Map metres [..., (x, y, z)] to fractional voxel indices [..., (bscan, axial, lateral)]; differentiable."""
        (d, h, w), (x, y, z) = self.spacing_m, self.origin_m
        return _stack(point_m, (point_m[..., 1] - y) / d, (point_m[..., 2] - z) / h, (point_m[..., 0] - x) / w)

    def voxel_to_canonical(self, index: Points) -> Points:
        """Map voxel indices to canonical coordinates [..., (lateral, axial, bscan)] in [-1, 1] (eq. 2)."""
        bscans, axials, laterals = self.shape
        return _stack(
            index,
            index[..., 2] * (2.0 / (laterals - 1)) - 1.0,
            index[..., 1] * (2.0 / (axials - 1)) - 1.0,
            index[..., 0] * (2.0 / (bscans - 1)) - 1.0,
        )

    def canonical_to_voxel(self, point: Points) -> Points:
        """Map canonical coordinates to fractional voxel indices, the inverse of eq. 2; differentiable."""
        bscans, axials, laterals = self.shape
        return _stack(
            point,
            (point[..., 2] + 1.0) * (0.5 * (bscans - 1)),
            (point[..., 1] + 1.0) * (0.5 * (axials - 1)),
            (point[..., 0] + 1.0) * (0.5 * (laterals - 1)),
        )

    def canonical_to_metric(self, point: Points) -> Points:
        """Map canonical coordinates [..., (lateral, axial, bscan)] to metres [..., (x, y, z)]; differentiable."""
        return self.voxel_to_metric(self.canonical_to_voxel(point))

    def metric_to_canonical(self, point_m: Points) -> Points:
        """Map metres [..., (x, y, z)] to canonical coordinates [..., (lateral, axial, bscan)]; differentiable."""
        return self.voxel_to_canonical(self.metric_to_voxel(point_m))

    @property
    def metres_per_canonical(self) -> tuple[float, float, float]:
        """Metres that one canonical unit spans along (lateral, axial, bscan); divide a gradient by it."""
        x, y, z = self.extent_m
        return x / 2, z / 2, y / 2

    def same_grid(self, other: VolumeGeometry) -> bool:
        """Return whether both have as many voxels as far apart, within a thousandth; where they lie does not count."""
        return self.shape == other.shape and all(
            math.isclose(mine, its, rel_tol=_SAME_SPACING)
            for mine, its in zip(self.spacing_m, other.spacing_m, strict=True)
        )

    def to_plain(self) -> dict[str, object]:
        """Return the geometry as lists and strings that JSON can hold."""
        return {
            "shape": list(self.shape),
            "spacing_m": list(self.spacing_m),
            "origin_m": list(self.origin_m),
            "frame": self.frame,
        }


def _stack(like: Points, *columns: Points) -> Points:
    if isinstance(like, np.ndarray):
        return np.stack(columns, axis=-1)
    import torch

    return torch.stack(columns, dim=-1)
