"""How close two images or volumes are."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError

# SSIM as Wang et al. (2004) define it: Gaussian window of 11 pixels, population covariance. Given to scikit-image in
# full, since its own defaults (a square window of 7, sample covariance) differ; reports carry them along.
SSIM_PARAMETERS: dict[str, Any] = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "truncate": 3.5,
    "use_sample_covariance": False,
    "K1": 0.01,
    "K2": 0.03,
}
SSIM_WINDOW = 11


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
    _check_range("psnr_db", data_range)
    total = 0.0
    for one, other in zip(np.atleast_2d(reference), np.atleast_2d(test), strict=True):
        difference = one.astype(np.float64) - other
        total += float(np.vdot(difference, difference))
    return psnr_from_error_db(total / reference.size, data_range)


def psnr_from_error_db(mean_squared_error: float, data_range: float = 1.0) -> float:
    """Return the PSNR in dB that a mean squared error stands for: infinity for none, NaN for one that is not finite."""
    if not math.isfinite(mean_squared_error):
        return math.nan
    return math.inf if mean_squared_error == 0.0 else 10.0 * math.log10(data_range**2 / mean_squared_error)


def ssim(reference: NDArray[Any], test: NDArray[Any], data_range: float = 1.0) -> float:
    """Mean structural similarity of two images, by scikit-image with `SSIM_PARAMETERS`.

    A Gaussian window of sigma 1.5 and 11 pixels, K1 = 0.01, K2 = 0.03, population covariance (Wang et al. 2004); the
    mean leaves out the rim of 5 pixels that the window does not cover. Volumes are compared B-scan by B-scan: the
    mean over their B-scans is the volume's figure. Thread-safe.

    Args:
        reference: intensities [axial, lateral], at least 11 x 11.
        test: intensities of the same shape.
        data_range: difference between the largest and smallest possible intensity.

    Returns:
        1 for equal images; symmetric in the two.

    Raises:
        QueryError: the shapes differ, the images are smaller than the window, or the range is not a positive number.
    """
    if reference.shape != test.shape or reference.ndim != 2 or min(reference.shape) < SSIM_WINDOW:
        raise QueryError(
            f"ssim: expected two images of one shape, {SSIM_WINDOW} x {SSIM_WINDOW} at least, "
            f"got {reference.shape} and {test.shape}"
        )
    _check_range("ssim", data_range)
    # Here, since it takes a third of a second to load and most users of this room want no SSIM.
    from skimage.metrics import structural_similarity

    one, other = reference.astype(np.float64), test.astype(np.float64)
    return float(structural_similarity(one, other, data_range=data_range, **SSIM_PARAMETERS))


def _check_range(name: str, data_range: float) -> None:
    if not (math.isfinite(data_range) and data_range > 0):
        raise QueryError(f"{name}: expected a positive data range, got {data_range}")
