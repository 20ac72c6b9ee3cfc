"""Noise filters on a whole C-scan."""

from __future__ import annotations

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
