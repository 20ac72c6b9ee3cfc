"""A measured C-scan: voxels, where they lie, and what their numbers mean."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.geometry import OCT_FRAME, VolumeGeometry

IntensityScale = Literal["linear", "log", "unknown"]
INTENSITY_SCALES: tuple[IntensityScale, ...] = ("linear", "log", "unknown")


@dataclass(frozen=True)
class Volume:
    """A C-scan as measured; immutable, safe to read from several threads.

    Attributes:
        array: voxels [bscan, axial, lateral], row 0 of the axial axis nearest the probe; uint8, uint16 or float32.
        geometry: shape and place in space.
        intensity_range: the raw values that become 0 and 1.
        intensity_scale: whether raw values are linear in reflected power or logarithmic.
        stamp_ns: acquisition time in nanoseconds, 0 if unknown.

    Raises:
        VolumeError: the voxels are not finite, all equal, of another type, or do not fit the geometry.
    """

    array: NDArray[Any]
    geometry: VolumeGeometry
    intensity_range: tuple[float, float]
    intensity_scale: IntensityScale = "unknown"
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        if self.array.dtype not in (np.uint8, np.uint16, np.float32):
            raise VolumeError(f"expected voxels of type uint8, uint16 or float32, got {self.array.dtype}")
        if self.array.shape != self.geometry.shape:
            raise VolumeError(f"expected {self.geometry.shape} voxels [bscan, axial, lateral], got {self.array.shape}")
        low, high = float(self.array.min()), float(self.array.max())
        # NaN and infinity propagate through min and max, so no mask of the whole volume is needed.
        if not np.isfinite(low) or not np.isfinite(high):
            bad = int(np.count_nonzero(~np.isfinite(self.array)))
            raise VolumeError(f"expected finite voxels, got {bad} NaN or infinite ones; mend or mask them first")
        if low == high:
            raise VolumeError(f"expected tissue in the volume, got a constant one (every voxel is {low:g})")
        start, end = self.intensity_range
        if not (np.isfinite(start) and np.isfinite(end) and start < end):
            raise VolumeError(f"expected an intensity range (low, high) with low < high, got {self.intensity_range}")

    @classmethod
    def from_array(
        cls,
        array: NDArray[Any],
        spacing_m: tuple[float, float, float],
        *,
        intensity_range: tuple[float, float] | None = None,
        intensity_scale: IntensityScale = "unknown",
        origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        stamp_ns: int = 0,
        frame: str = OCT_FRAME,
    ) -> Volume:
        """Wrap an array [bscan, axial, lateral], converting types this package does not keep to float32.

        Without `intensity_range`, integers use the range of their type; floats use [0, 1] if they lie in it and
        their own minimum and maximum otherwise.

        Raises:
            VolumeError: as the constructor, or the array is not three-dimensional and real.
        """
        array = np.asarray(array)
        if array.ndim != 3:
            raise VolumeError(f"expected an array [bscan, axial, lateral], got {array.ndim} axes of {array.shape}")
        if array.dtype.kind not in "uif":
            raise VolumeError(f"expected real intensities, got type {array.dtype}")
        geometry = VolumeGeometry(tuple(array.shape), tuple(spacing_m), tuple(origin_m), frame)  # type: ignore[arg-type]
        if intensity_range is None:
            intensity_range = _default_range(array)
        # One step for type and order: a volume of this size has no room for two copies.
        array = np.ascontiguousarray(array.astype(kept_type(array.dtype), order="C", copy=False))
        return cls(array, geometry, intensity_range, intensity_scale, stamp_ns)

    def normalized(self, index: Any = ...) -> NDArray[np.float32]:
        """Return intensities in [0, 1] as float32 [bscan, axial, lateral]; values outside the range are clipped.

        Args:
            index: which voxels, as NumPy indexes the array; all of them if not given. A few B-scans at a time keep a
                large volume from being copied whole.
        """
        return self.intensity_of(self.array[index])

    def intensity_of(self, raw: NDArray[Any]) -> NDArray[np.float32]:
        """Return the intensities in [0, 1], float32, that raw values of any shape stand for; rising with them."""
        low, high = self.intensity_range
        values = np.asarray(raw).astype(np.float32)
        values -= np.float32(low)
        values *= np.float32(1.0 / (high - low))
        return np.clip(values, 0.0, 1.0, out=values)

    def replace_intensity(self, intensity: NDArray[np.float32]) -> Volume:
        """Return the same scan with normalised intensities [bscan, axial, lateral], after a filter for instance."""
        return dataclasses.replace(
            self, array=np.ascontiguousarray(intensity, dtype=np.float32), intensity_range=(0.0, 1.0)
        )


def kept_type(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type in which a Volume keeps voxels of a real type: itself for uint8 and uint16, or float32."""
    if dtype.kind == "u" and dtype.itemsize <= 2:
        return dtype.newbyteorder("=")
    return np.dtype(np.float32)


def integer_range(dtype: np.dtype[Any]) -> tuple[float, float] | None:
    """Return the smallest and largest number of an integer type, None for other types."""
    if dtype.kind not in "ui":
        return None
    info = np.iinfo(dtype)
    return float(info.min), float(info.max)


def _default_range(array: NDArray[Any]) -> tuple[float, float]:
    integers = integer_range(array.dtype)
    if integers is not None:
        return integers
    low, high = (float(array.min()), float(array.max())) if array.size else (0.0, 1.0)
    # Anything that is not a usable range is left to the constructor, which says what is wrong with the voxels.
    return (0.0, 1.0) if not low < high or (low >= 0.0 and high <= 1.0) else (low, high)
