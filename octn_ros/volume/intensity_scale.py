"""From intensities linear in reflected power to decibels."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from octn_ros.errors import ConfigurationError, VolumeError
from octn_ros.volume.volume import Volume


def to_log_scale(volume: Volume, dynamic_range_db: float) -> Volume:
    """Return a volume of decibels below the upper end of the intensity range: 10 log10(I), float32.

    Args:
        volume: intensities declared linear in reflected power.
        dynamic_range_db: what lies further below the top is clipped; the new intensity range is
            (-dynamic_range_db, 0).

    Raises:
        VolumeError: the intensities are not declared linear.
        ConfigurationError: the dynamic range is not a positive number.
    """
    if not (math.isfinite(dynamic_range_db) and dynamic_range_db > 0):
        raise ConfigurationError(f"expected a dynamic range above 0 dB, got {dynamic_range_db}")
    if volume.intensity_scale != "linear":
        raise VolumeError(
            f"expected intensities declared linear, got {volume.intensity_scale}; if they are linear in reflected "
            "power, declare it with --scale linear, in Python with intensity_scale"
        )
    decibel = volume.normalized()
    np.maximum(decibel, np.float32(10 ** (-dynamic_range_db / 10)), out=decibel)
    np.log10(decibel, out=decibel)
    decibel *= np.float32(10)
    return dataclasses.replace(
        volume, array=decibel, intensity_range=(-float(dynamic_range_db), 0.0), intensity_scale="log"
    )
