"""A C-scan put together from B-scan images as they arrive, each placed by the pose of its image frame."""

from __future__ import annotations

import math
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.geometry import VolumeGeometry
from octn_ros.volume.volume import IntensityScale, Volume

IMAGE2OCT_ROTATION: NDArray[np.float64] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Axes of the B-scan image frame in the OCT frame: x = lateral, y = axial (image down), z = -bscan."""
IMAGE2OCT_ROTATION.flags.writeable = False

# How far a B-scan may lie from its place, as a share of the spacing: wide of what float32 poses lose, and far below
# the half spacing at which the index would be ambiguous.
_PLACE_TOLERANCE = 0.1
_ROTATION_TOLERANCE = 1e-3
_DTYPES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))


class CScanAssembler:
    """Assembles C-scans from B-scans in order, one after another; not thread-safe, keeps one C-scan in memory.

    The OCT frame's origin is the centre of the first voxel of B-scan 0, so the index of a B-scan is its y over the
    spacing. B-scan 0 begins a C-scan. A B-scan that does not fit drops the partial C-scan: `add` raises once, and the
    rest of that C-scan is then left aside without a further error until a B-scan 0 arrives.

    Args:
        bscan_count: number of B-scans in a C-scan, at least 2.
        spacing_m: metres between voxel centres along (bscan, axial, lateral).
        intensity_scale: what the voxel values mean, written into the Volume.

    Raises:
        VolumeError: the count is below 2, or a spacing is not positive.
    """

    def __init__(
        self,
        bscan_count: int,
        spacing_m: tuple[float, float, float],
        intensity_scale: IntensityScale = "unknown",
    ) -> None:
        VolumeGeometry((bscan_count, 2, 2), spacing_m)
        self._count = bscan_count
        self._spacing_m = spacing_m
        self._scale = intensity_scale
        self._voxels: NDArray[Any] | None = None
        self._received = 0
        self._origin_m = (0.0, 0.0, 0.0)
        self._stamp_ns = 0
        self._last_stamp_ns = 0
        self._aside = False

    @property
    def received(self) -> int:
        """Number of B-scans of the present C-scan, 0 when none has begun."""
        return self._received

    def add(self, image: NDArray[Any], image2oct: NDArray[np.floating], stamp_ns: int) -> Volume | None:
        """Take the next B-scan.

        Args:
            image: intensities [axial, lateral] of uint8, uint16 or float32; copied.
            image2oct: pose of the image frame in the OCT frame, 4x4, metres.
            stamp_ns: acquisition time in nanoseconds.

        Returns:
            The C-scan with the stamp of its B-scan 0 when this B-scan completes it, else None.

        Raises:
            VolumeError: names the index of a B-scan of another size, type, direction or place, out of order, repeated
                or late, and of those missing before it; or the complete C-scan is not a usable Volume. The partial
                C-scan is dropped. Where B-scan 0 interrupts a C-scan, the new one has begun nevertheless.
        """
        pose = np.asarray(image2oct, dtype=np.float64)
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
            self._drop(f"expected a finite 4x4 pose of the B-scan, got {pose.tolist()}")
        place = float(pose[1, 3]) / self._spacing_m[0]
        if abs(place) > _PLACE_TOLERANCE and self._aside:
            return None
        index = self._index(pose, place)
        if index == 0:
            interrupted = self._received
            self._begin(image, pose, stamp_ns)
            if interrupted:
                raise VolumeError(
                    f"expected B-scan {interrupted} of {self._count}, got B-scan 0; "
                    f"the C-scan of {interrupted} B-scans is dropped and a new one has begun"
                )
            return None
        if self._voxels is None:
            self._drop(f"expected B-scan 0, which begins a C-scan, got B-scan {index}; waiting for a B-scan 0")
        self._check(index, image, pose, stamp_ns)
        self._voxels[index] = image
        self._received += 1
        self._last_stamp_ns = stamp_ns
        return self._finish() if self._received == self._count else None

    def _index(self, pose: NDArray[np.float64], place: float) -> int:
        index = math.floor(place + 0.5)
        if np.abs(pose[:3, :3] - IMAGE2OCT_ROTATION).max() > _ROTATION_TOLERANCE:
            self._drop(
                f"B-scan {index}: expected image axes x, y, z along lateral, axial and -bscan of the OCT frame, got "
                f"{np.round(pose[:3, :3], 4).tolist()}; mirror a scan direction in the scanner's configuration instead"
            )
        if abs(place - index) > _PLACE_TOLERANCE:
            self._drop(
                f"expected B-scans every {self._spacing_m[0] * 1e6:g} um from y = 0, got one at y = "
                f"{pose[1, 3] * 1e6:g} um, between the indices {math.floor(place)} and {math.floor(place) + 1}"
            )
        if not 0 <= index < self._count:
            self._drop(f"expected B-scan indices 0 to {self._count - 1}, got {index} (y = {pose[1, 3] * 1e6:g} um)")
        return index

    def _begin(self, image: NDArray[Any], pose: NDArray[np.float64], stamp_ns: int) -> None:
        if image.ndim != 2 or min(image.shape) < 2 or image.dtype not in _DTYPES:
            self._drop(
                "B-scan 0: expected an image [axial, lateral] of at least 2 x 2 uint8, uint16 or float32, "
                f"got {image.shape} of {image.dtype}"
            )
        self._voxels = np.empty((self._count, *image.shape), dtype=image.dtype)
        self._voxels[0] = image
        self._received = 1
        self._origin_m = (float(pose[0, 3]), float(pose[1, 3]), float(pose[2, 3]))
        self._stamp_ns = self._last_stamp_ns = stamp_ns
        self._aside = False

    def _check(self, index: int, image: NDArray[Any], pose: NDArray[np.float64], stamp_ns: int) -> None:
        assert self._voxels is not None
        if index < self._received:
            self._drop(f"expected B-scan {self._received} of {self._count}, got B-scan {index} again")
        if index > self._received:
            missing = f"{self._received}" if index == self._received + 1 else f"{self._received} to {index - 1}"
            self._drop(f"expected B-scan {self._received} of {self._count}, got B-scan {index}; missing: {missing}")
        first = self._voxels[0]
        if image.shape != first.shape or image.dtype != first.dtype:
            self._drop(
                f"B-scan {index}: expected {first.shape} of {first.dtype} as in B-scan 0, "
                f"got {image.shape} of {image.dtype}"
            )
        shift = (float(pose[0, 3]) - self._origin_m[0], float(pose[2, 3]) - self._origin_m[2])
        _, axial_m, lateral_m = self._spacing_m
        if abs(shift[0]) > _PLACE_TOLERANCE * lateral_m or abs(shift[1]) > _PLACE_TOLERANCE * axial_m:
            self._drop(
                f"B-scan {index}: expected it where B-scan 0 begins, got it shifted by {shift[0] * 1e6:.2f} um "
                f"laterally and {shift[1] * 1e6:.2f} um axially"
            )
        if stamp_ns < self._last_stamp_ns:
            self._drop(
                f"B-scan {index}: expected a stamp of at least {self._last_stamp_ns} ns, that of B-scan {index - 1}, "
                f"got {stamp_ns} ns; it belongs to an older C-scan"
            )

    def _finish(self) -> Volume:
        voxels, stamp_ns = self._voxels, self._stamp_ns
        assert voxels is not None
        # Reset first: whatever the Volume says of the voxels, this C-scan is over.
        self._voxels, self._received = None, 0
        return Volume.from_array(
            voxels, self._spacing_m, intensity_scale=self._scale, origin_m=self._origin_m, stamp_ns=stamp_ns
        )

    def _drop(self, reason: str) -> NoReturn:
        self._voxels, self._received, self._aside = None, 0, True
        raise VolumeError(reason)
