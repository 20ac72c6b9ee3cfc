"""What the paper filters scans with before a fit: nothing, a Gaussian or a median of 3 voxels."""

from __future__ import annotations

from octn_ros.errors import ConfigurationError
from octn_ros.volume import Volume, gaussian_filter_of_size, median_filter

NOISE_REDUCTIONS = ("raw", "gaussian", "median")


def reduce_noise(volume: Volume, how: str) -> Volume:
    """Return the scan as it is ("raw"), or after the three-dimensional Gaussian or median with a kernel of 3 voxels.

    Raises:
        ConfigurationError: there is no such filter.
    """
    if how == "raw":
        return volume
    if how == "gaussian":
        return gaussian_filter_of_size(volume)
    if how == "median":
        return median_filter(volume)
    raise ConfigurationError(f"noise reduction: expected one of {', '.join(NOISE_REDUCTIONS)}, got {how!r}")
