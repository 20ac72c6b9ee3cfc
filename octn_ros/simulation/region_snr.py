"""What SNR a phantom's regions show: tissue below the surface against the air above it, in closed form.

`snr_db` of a configuration is the ratio of mean reflected powers at the surface itself. A region below it shows less,
because light is lost on the way down; and the paper's figure, taken from displayed intensities, is another quantity:
it depends on the speckle and on where air lies in the display as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from octn_ros.errors import ConfigurationError
from octn_ros.metrics import snr_from_moments_db
from octn_ros.simulation.layers import layered_power
from octn_ros.simulation.phantom_config import PhantomConfig
from octn_ros.simulation.speckle import Speckle

_DEPTHS = 400


@dataclass(frozen=True)
class RegionSnr:
    """SNR of a tissue region against air, expected over the speckle.

    Attributes:
        power_db: 10 log10(mean power of the region / mean power of air), before the display clips either.
        displayed_db: 10 log10(mean(tissue)^2 / var(air)) of the displayed intensities, as `octn_ros.metrics.snr_db`.
    """

    power_db: float
    displayed_db: float


def region_snr(config: PhantomConfig, start_m: float = 30e-6, end_m: float = 130e-6) -> RegionSnr:
    """Return the SNR that tissue between two depths below the surface shows against air.

    With R = 10^(snr_db / 10), power_db = 10 log10(1 + (R - 1) * mean over depth of gain(d) exp(-2 mu d)). Both hold
    where there is neither inclusion nor artefact.

    Args:
        config: of the phantom.
        start_m: least depth below the surface; keep a point spread away from it.
        end_m: largest depth below the surface.

    Raises:
        ConfigurationError: the depths are not in order.
    """
    if not 0.0 <= start_m < end_m:
        raise ConfigurationError(f"region_snr: expected 0 <= start_m < end_m, got {start_m} and {end_m}")
    depth = np.linspace(start_m, end_m, _DEPTHS, dtype=np.float32)
    power = layered_power(config, depth).astype(np.float64)
    speckle = Speckle.named(config.speckle, config.dynamic_range_db, config.grain_voxels)
    levels = config.air_level_db + 10.0 * np.log10(1.0 + power)
    tissue = float(speckle.expected_display(levels, config.dynamic_range_db).mean())
    variance = float(speckle.display_variance(np.array([config.air_level_db]), config.dynamic_range_db)[0])
    return RegionSnr(10.0 * math.log10(1.0 + power.mean()), snr_from_moments_db(tissue, variance))
