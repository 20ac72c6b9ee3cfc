"""Which raw values become 0 and 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ConfigurationError, VolumeError
from octn_ros.settings import check_settings, setting
from octn_ros.volume.volume import integer_range

NORMALISATIONS = ("type", "minmax", "percentile")
_SAMPLE = 2**22  # voxels of a float array that its percentiles are taken from


@dataclass(frozen=True)
class Normalisation:
    """A declared choice of the intensity range; immutable.

    Attributes:
        kind: type, the range of the file's integers ([0, 1] for floats that lie in it); minmax, the smallest and the
            largest voxel; percentile, the two percentiles below.
        low, high: percentiles that become 0 and 1; used by `percentile` alone.

    Raises:
        ConfigurationError: the kind is unknown, or the percentiles are not 0 <= low < high <= 100.
    """

    kind: str = setting("type", "which raw values become 0 and 1", choices=NORMALISATIONS)
    low: float = setting(1.0, "percentile that becomes 0", unit="%", low=0, high=100)
    high: float = setting(99.0, "percentile that becomes 1", unit="%", low=0, high=100)

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.low < self.high:
            raise ConfigurationError(f"expected a low percentile below the high one, got {self.low} and {self.high}")

    def intensity_range(
        self, array: NDArray[Any], type_range: tuple[float, float] | None = None
    ) -> tuple[float, float]:
        """Return the raw values that become 0 and 1.

        Percentiles of integers up to 16 bits are exact; those of other types are taken from at most four million
        voxels spread evenly over the array.

        Args:
            array: raw voxels [bscan, axial, lateral] of any real type.
            type_range: range of the integers the voxels had in their file; None: as the array has them.

        Raises:
            VolumeError: floats outside [0, 1] have no type range, or all voxels in the range are equal.
        """
        if self.kind == "type":
            return type_range or _type_range(array)
        percentile = self.kind == "percentile"
        low, high = percentiles(array, (self.low, self.high)) if percentile else (array.min(), array.max())
        if low == high:
            raise VolumeError(
                f"expected two different values as intensity range, normalisation {self.kind} gives {low:g} twice"
            )
        return float(low), float(high)


def percentiles(array: NDArray[Any], which: tuple[float, ...]) -> tuple[float, ...]:
    """Return percentiles of raw voxels [bscan, axial, lateral], in one pass over them.

    Those of integers up to 16 bits are exact; those of other types are taken from at most four million voxels spread
    evenly over the array.

    Args:
        array: raw voxels of any real type.
        which: the percentiles, 0 to 100.
    """
    if array.dtype.kind in "ui" and array.dtype.itemsize <= 2:
        start = int(np.iinfo(array.dtype).min)
        counts = np.zeros(2 ** (8 * array.dtype.itemsize), np.int64)
        for part in array:  # bincount needs indices of 8 bytes: never of the whole volume at once
            counts += np.bincount(part.ravel().astype(np.int64) - start, minlength=counts.size)
        rank = np.cumsum(counts)
        return tuple(start + float(np.searchsorted(rank, max(1, np.ceil(q / 100 * array.size)))) for q in which)
    sample = array[:: max(1, array.size // _SAMPLE // max(1, array[0].size) + 1)]
    step = max(1, sample.size // _SAMPLE)
    return tuple(float(value) for value in np.percentile(sample.ravel()[::step], which))


def _type_range(array: NDArray[Any]) -> tuple[float, float]:
    integers = integer_range(array.dtype)
    if integers is not None:
        return integers
    if array.min() >= 0.0 and array.max() <= 1.0:
        return 0.0, 1.0
    raise VolumeError(
        f"expected integers, or floats in [0, 1], for the normalisation by type; got {array.dtype} from "
        f"{array.min():g} to {array.max():g}; choose minmax or percentile"
    )
