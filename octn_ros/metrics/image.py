"""How close two images or volumes are."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError


def psnr_db(reference: NDArray[Any], test: NDArray[Any], data_range: float = 1.0) -> float:
    """Peak signal-to-noise ratio of `test` against `reference` in decibel.

    Thread-safe; sums in float64 slice by slice, so that a large volume needs no second copy.

    Args:
        reference: intensities of any shape, at least one axis.
        test: intensities of the same shape.
        data_range: difference between the largest and smallest possible intensity.

    Returns:
        10 log10(data_range^2 / mean squared error); infinity when the two are equal.

    Raises:
        QueryError: the shapes differ, nothing is there to compare, or the range is not a positive number.
    """
    if reference.shape != test.shape or reference.size == 0:
        raise QueryError(f"psnr_db: expected two filled arrays of one shape, got {reference.shape} and {test.shape}")
    if not (math.isfinite(data_range) and data_range > 0):
        raise QueryError(f"psnr_db: expected a positive data range, got {data_range}")
    total = 0.0
    for one, other in zip(np.atleast_2d(reference), np.atleast_2d(test), strict=True):
        difference = one.astype(np.float64) - other
        total += float(np.vdot(difference, difference))
    error = total / reference.size
    return math.inf if error == 0.0 else 10.0 * math.log10(data_range**2 / error)
