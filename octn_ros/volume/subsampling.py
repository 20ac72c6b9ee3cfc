"""The paper's sparse protocol: every SF-th B-scan is kept, the others are held out to test against."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from octn_ros.errors import VolumeError
from octn_ros.volume.volume import Volume


@dataclass(frozen=True)
class SparseScan:
    """A C-scan with fewer B-scans, and which they are; immutable.

    Attributes:
        volume: the kept B-scans; B-scan spacing is the factor times the dense one.
        factor: the paper's SF.
        kept: indices in the dense volume of the B-scans kept: 0, SF, 2 SF, ...
        held_out: indices of those that lie between kept ones, to compare a reconstruction with.
        beyond: indices after the last kept one, which would have to be extrapolated.
    """

    volume: Volume
    factor: int
    kept: tuple[int, ...]
    held_out: tuple[int, ...]
    beyond: tuple[int, ...]


def subsample_bscans(volume: Volume, factor: int) -> SparseScan:
    """Keep every `factor`-th B-scan, beginning with the first; the rest of the geometry stays.

    Args:
        volume: the dense C-scan.
        factor: the paper's SF, at least 1.

    Raises:
        VolumeError: the factor is below 1, or fewer than two B-scans would be left.
    """
    bscans = volume.geometry.shape[0]
    if not 1 <= factor < bscans:
        raise VolumeError(f"expected a factor of 1 to {bscans - 1} for {bscans} B-scans, got {factor}")
    kept = tuple(range(0, bscans, factor))
    bscan_m, axial_m, lateral_m = volume.geometry.spacing_m
    geometry = dataclasses.replace(
        volume.geometry,
        shape=(len(kept), *volume.geometry.shape[1:]),
        spacing_m=(bscan_m * factor, axial_m, lateral_m),
    )
    return SparseScan(
        volume=dataclasses.replace(volume, array=volume.array[::factor].copy(), geometry=geometry),
        factor=factor,
        kept=kept,
        held_out=tuple(index for index in range(kept[-1]) if index % factor),
        beyond=tuple(range(kept[-1] + 1, bscans)),
    )
