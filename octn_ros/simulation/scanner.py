"""A simulated OCT scanner: any C-scan, a phantom's or a recorded one, played as B-scan images with their poses."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ConfigurationError
from octn_ros.volume.bscan_places import IMAGE2OCT_ROTATION
from octn_ros.volume.volume import Volume


@dataclass(frozen=True)
class BScan:
    """One cross-section as a scanner delivers it.

    Attributes:
        image: raw intensities [axial, lateral], a read-only view of the C-scan in its own type.
        index: number in the C-scan, 0 begins one.
        image2oct: pose of the B-scan image frame in the OCT frame, 4x4, metres.
        stamp_ns: acquisition time in nanoseconds.
    """

    image: NDArray[Any]
    index: int
    image2oct: NDArray[np.float64]
    stamp_ns: int


class Scanner:
    """Plays one C-scan over and over; immutable and thread-safe.

    Args:
        volume: what the scanner sees.
        factor: the paper's SF: every so many-th B-scan of the volume is acquired, beginning with the first.

    Attributes:
        volume: what the scanner sees.
        count: B-scans of a C-scan.
        spacing_m: distance from one to the next.

    Raises:
        ConfigurationError: fewer than two B-scans would be left.
    """

    def __init__(self, volume: Volume, factor: int = 1) -> None:
        bscans = volume.geometry.shape[0]
        if not 1 <= factor < bscans:
            raise ConfigurationError(f"expected a factor of 1 to {bscans - 1} for {bscans} B-scans, got {factor}")
        self.volume, self._factor = volume, factor
        self.count = len(range(0, bscans, factor))
        self.spacing_m = volume.geometry.spacing_m[0] * factor

    @property
    def content_hash(self) -> str:
        """Identity of a C-scan as it is played: its voxels, type and geometry; 16 hex digits of SHA-256."""
        played, geometry = self.volume.array[:: self._factor], self.volume.geometry
        digest = hashlib.sha256(repr((played.dtype.str, played.shape, geometry.spacing_m, self._factor)).encode())
        for image in played:
            digest.update(np.ascontiguousarray(image).data)
        return digest.hexdigest()[:16]

    def bscans(self, start_ns: int, period_ns: int) -> Iterator[BScan]:
        """Return the B-scans of one C-scan in order, without waiting between them.

        Args:
            start_ns: stamp of B-scan 0.
            period_ns: time from one acquired B-scan to the next.

        Raises:
            ConfigurationError: the period is negative.
        """
        if period_ns < 0:
            raise ConfigurationError(f"expected a B-scan period of at least 0 ns, got {period_ns} ns")
        return (self._bscan(index, start_ns + index * period_ns) for index in range(self.count))

    def _bscan(self, index: int, stamp_ns: int) -> BScan:
        place = index * self._factor
        image = self.volume.array[place].view()
        image.flags.writeable = False
        image2oct = np.eye(4)
        image2oct[:3, :3] = IMAGE2OCT_ROTATION
        image2oct[:3, 3] = self.volume.geometry.voxel_to_metric(np.array([place, 0, 0], dtype=np.float64))
        return BScan(image, index, image2oct, stamp_ns)
