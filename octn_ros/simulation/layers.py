"""How bright tissue is with depth: the edge at the surface, attenuation, layers, a bright top layer."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from octn_ros.simulation.phantom_config import PhantomConfig

# Layers that follow the surface: depth below it in metres, backscatter against the top layer in dB. The ramps between
# them are gentle, so that the largest axial gradient stays at the surface.
_LAYER_DEPTH_M = (200e-6, 260e-6, 480e-6, 540e-6, 950e-6, 1050e-6)
_LAYER_GAIN_DB = (0.0, -3.0, -3.0, 1.0, 1.0, -1.0)
_TOP_LAYER_FADE_M = 40e-6  # below a bright top layer


def axial_sigma_m(config: PhantomConfig) -> float:
    """Return the standard deviation of the axial point spread in metres."""
    return config.resolution_m / math.sqrt(8.0 * math.log(2.0))


def tissue_over_air(config: PhantomConfig) -> float:
    """Return the tissue's own mean power at the surface over air's, so that both together are `snr_db` over air."""
    return float(10.0 ** (config.snr_db / 10.0) - 1.0)


def layered_power(
    config: PhantomConfig, below_m: NDArray[np.float32], before_m: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return the mean power of layered tissue over air's.

    (10^(snr / 10) - 1) * gain(d) * exp(-2 mu d) for d > 0 and nothing above, convolved with the axial point spread.

    Args:
        config: of the phantom.
        below_m: depth d below the surface, metres, any shape.
        before_m: depth below the surface before a crater was cut, which the layers follow; None where none was.
    """
    # exp(-2 mu d) behind a sharp edge, convolved with a Gaussian of sigma, in closed form.
    sigma, loss = axial_sigma_m(config), 2.0 * config.attenuation_per_m
    power = ndtr(below_m * np.float32(1.0 / sigma) - np.float32(loss * sigma))
    # Far above the surface the first factor is zero, and the second must not be infinite.
    depth = np.maximum(below_m, np.float32(-10.0 * sigma))
    power *= np.exp(np.float32(0.5 * (loss * sigma) ** 2) - np.float32(loss) * depth)
    power *= np.float32(tissue_over_air(config))
    layered = below_m if before_m is None else before_m
    power *= _gain(layered, _LAYER_DEPTH_M, _LAYER_GAIN_DB)
    if config.top_layer_db > 0.0:
        ends = (config.top_layer_m, config.top_layer_m + _TOP_LAYER_FADE_M)
        power *= _gain(layered, ends, (config.top_layer_db, 0.0))
    return np.asarray(power)


def _gain(depth: NDArray[np.float32], nodes_m: tuple[float, ...], gains_db: tuple[float, ...]) -> NDArray[np.float32]:
    return np.asarray(10.0 ** (np.interp(depth, nodes_m, gains_db).astype(np.float32) / np.float32(10.0)))
