"""What a file says of its C-scan before any voxel is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from octn_ros.volume.geometry import VolumeGeometry
from octn_ros.volume.volume import IntensityScale, Volume


@dataclass(frozen=True)
class ScanDescription:
    """Everything about a C-scan that can be told without its voxels; immutable. The Volume in the file agrees with it.

    Attributes:
        geometry: shape and place in space.
        dtype: type of the voxels in memory: uint8, uint16 or float32; None where only the voxels tell it (MATLAB 5).
        intensity_range: the raw values that become 0 and 1; None where only the voxels tell them.
        intensity_scale: linear, log or unknown.
        stamp_ns: acquisition time in nanoseconds, 0 if unknown.
    """

    geometry: VolumeGeometry
    dtype: np.dtype[Any] | None
    intensity_range: tuple[float, float] | None
    intensity_scale: IntensityScale
    stamp_ns: int

    @classmethod
    def of(cls, volume: Volume) -> ScanDescription:
        """Return what there is to say of a volume."""
        return cls(volume.geometry, volume.array.dtype, volume.intensity_range, volume.intensity_scale, volume.stamp_ns)
