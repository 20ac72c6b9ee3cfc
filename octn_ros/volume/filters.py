"""Noise filters on a whole C-scan."""

from __future__ import annotations

import dataclasses
import math

from scipy import ndimage

from octn_ros.errors import ConfigurationError
from octn_ros.volume.volume import Volume


def gaussian_filter(volume: Volume, sigma_voxels: float = 1.0) -> Volume:
    """Return the volume after a three-dimensional Gaussian of `sigma_voxels` along every axis.

    The plain way to remove speckle, and the yardstick that a fitted field is compared with. Edges are extended by
    their nearest voxel.

    Raises:
        ConfigurationError: the width is not a positive number.
    """
    if not (math.isfinite(sigma_voxels) and sigma_voxels > 0):
        raise ConfigurationError(f"expected a Gaussian width above 0 voxels, got {sigma_voxels}")
    return volume.replace_intensity(ndimage.gaussian_filter(volume.normalized(), sigma_voxels, mode="nearest"))


def gaussian_filter_of_size(volume: Volume, size: int = 3) -> Volume:
    """Return the volume after a Gaussian whose kernel is `size` voxels wide along every axis.

    The paper smooths its TissueOCT volumes with a "filter of 3" and says no more. Taken here as image libraries take
    a kernel size without a width, sigma = 0.3 ((size - 1) / 2 - 1) + 0.8: for size 3 sigma is 0.8 voxels and the
    kernel (0.239, 0.522, 0.239). Three-dimensional; edges are extended by their nearest voxel.

    Raises:
        ConfigurationError: the size is not an odd number of at least 3.
    """
    _check_size(size)
    radius = (size - 1) // 2
    sigma_voxels = 0.3 * (radius - 1) + 0.8
    smoothed = ndimage.gaussian_filter(volume.normalized(), sigma_voxels, mode="nearest", radius=radius)
    return volume.replace_intensity(smoothed)


def median_filter(volume: Volume, size: int = 3) -> Volume:
    """Return the volume with every voxel replaced by the median of the cube of `size` voxels around it.

    Size 3 is the paper's. A median is one of the values there were, so type, intensity range and scale stay. Edges
    are extended by their nearest voxel.

    Raises:
        ConfigurationError: the size is not an odd number of at least 3.
    """
    _check_size(size)
    return dataclasses.replace(volume, array=ndimage.median_filter(volume.array, size, mode="nearest"))


def _check_size(size: int) -> None:
    if size < 3 or size % 2 == 0:
        raise ConfigurationError(f"expected an odd filter size of at least 3 voxels, got {size}")
