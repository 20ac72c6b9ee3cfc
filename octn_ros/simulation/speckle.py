"""Speckle: how the reflected power fluctuates, and what a logarithmic display makes of it on average."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import brentq
from scipy.special import gammainccinv, gammaincinv, ndtr, polygamma

from octn_ros.errors import ConfigurationError

AVERAGED_PSNR_DB = 31.0
"""PSNR of an `averaged` phantom against its noise-free truth, which the paper's TissueOCT figures imply."""

_DB_PER_NEPER = 10.0 / math.log(10.0)
# Standard normal deviates at which the gain is tabulated; a normal deviate leaves them once in 10^9 draws.
_DEVIATES = np.linspace(-6.0, 6.0, 4097)


def averaged_looks(dynamic_range_db: float) -> float:
    """Return the number of looks at which a display of `dynamic_range_db` lies 31 dB from its noise-free truth.

    Power averaged over k looks is gamma distributed, and the logarithm of a gamma variable has the variance
    trigamma(k) whatever its mean. So k solves trigamma(k) = (range / (10 / ln 10))^2 * 10^(-31 / 10).
    """
    variance = (dynamic_range_db / _DB_PER_NEPER) ** 2 * 10.0 ** (-AVERAGED_PSNR_DB / 10.0)
    # trigamma falls from 1/k^2 near zero to 1/k far out, which brackets the root for every display range.
    return float(brentq(lambda k: float(polygamma(1, k)) - variance, 1e-3, 2.0 + 2.0 / variance))


@dataclass(frozen=True)
class Speckle:
    """Multiplicative speckle of unit mean power; immutable and thread-safe, NumPy only.

    The power is a gamma variable (exponential for one look) made from a normal field by its distribution function, so
    that speckle with a grain has exactly the same distribution at each voxel as speckle without.

    Attributes:
        looks: number of independent looks averaged, 1 for fully developed speckle.
        grain_voxels: lateral lag, in voxels, at which the correlation has fallen to about 1/e; 0 makes every voxel
            its own draw. B-scans and depths are independent of each other.
    """

    looks: float
    grain_voxels: float = 0.0

    @classmethod
    def named(cls, kind: str, dynamic_range_db: float, grain_voxels: float = 0.0) -> Speckle:
        """Return the speckle called `single-look` or `averaged`.

        Raises:
            ConfigurationError: it has another name.
        """
        if kind == "single-look":
            return cls(1.0, grain_voxels)
        if kind == "averaged":
            return cls(averaged_looks(dynamic_range_db), grain_voxels)
        raise ConfigurationError(f"speckle: expected single-look or averaged, got {kind!r}")

    def draw_db(self, generator: np.random.Generator, shape: tuple[int, int, int]) -> NDArray[np.float32]:
        """Draw gains in dB for voxels [bscan, axial, lateral]; splitting along bscan continues the same sequence."""
        deviates = generator.standard_normal(shape, dtype=np.float32)
        if self.grain_voxels > 0.0:
            # The autocorrelation of white noise after a Gaussian of sigma falls to 1/e at a lag of 2 sigma.
            sigma = self.grain_voxels / 2.0
            impulse = np.zeros(shape[2])
            impulse[0] = 1.0
            deviates = gaussian_filter1d(deviates, sigma, axis=2, mode="wrap")
            deviates /= np.float32(np.linalg.norm(gaussian_filter1d(impulse, sigma, mode="wrap")))
        return np.interp(deviates, _DEVIATES, _gain_db(self.looks)).astype(np.float32)

    def expected_display(self, level_db: NDArray[np.floating], dynamic_range_db: float) -> NDArray[np.float64]:
        """Return the mean of clip(level + gain, 0, range) / range over the speckle.

        Args:
            level_db: mean power above the display's black, dB, 1-D [N].
            dynamic_range_db: white above black, dB.

        Returns:
            Displayed intensity in [0, 1], [N], clipping at both ends included.
        """
        display, weights = self._displays(level_db, dynamic_range_db)
        return np.asarray(display @ weights)

    def display_variance(self, level_db: NDArray[np.floating], dynamic_range_db: float) -> NDArray[np.float64]:
        """Return the variance over the speckle of what `expected_display` is the mean of; same arguments."""
        display, weights = self._displays(level_db, dynamic_range_db)
        return np.asarray(display**2 @ weights - (display @ weights) ** 2)

    def _displays(
        self, level_db: NDArray[np.floating], dynamic_range_db: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        deviates, gain = _DEVIATES[::4], _gain_db(self.looks)[::4]
        weights = np.exp(-0.5 * deviates**2)
        weights /= weights.sum()
        return np.clip((np.asarray(level_db)[:, None] + gain) / dynamic_range_db, 0.0, 1.0), weights


@lru_cache(maxsize=8)
def _gain_db(looks: float) -> NDArray[np.float64]:
    """Return the gain in dB at each tabulated deviate: the gamma quantile of the same probability."""
    # Each half is taken from its own tail, where the probability keeps its digits.
    low, high = _DEVIATES[_DEVIATES < 0], _DEVIATES[_DEVIATES >= 0]
    quantiles = np.concatenate([gammaincinv(looks, ndtr(low)), gammainccinv(looks, ndtr(-high))])
    return np.asarray(_DB_PER_NEPER * np.log(quantiles / looks))
