"""How tissue stands out of noise in an image, and how its edges survive."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError


def snr_db(tissue: NDArray[Any], air: NDArray[Any]) -> float:
    """Signal-to-noise ratio of one image in decibel: tissue is the signal, air above it the noise.

    SNR = 10 log10(mean(tissue)^2 / var(air)), both in displayed intensity. This formula is our choice: the paper names
    the two regions and cites Wu et al. (2021), whose formula we have not found. It is compatible with the paper's
    table (13 to 18 dB for tissue of half the display's range over air that varies by a tenth of it, and 2 dB more for
    all regions alike after a fit that smooths the air); others may be. The ratio of mean powers behind a logarithmic
    display, the `snr_db` of a phantom, is another quantity.

    Args:
        tissue: intensities of the signal region, any shape.
        air: intensities of the noise region, any shape, at least 2.

    Returns:
        The ratio in dB; infinity where air does not vary, minus infinity where the tissue is black.

    Raises:
        QueryError: a region is empty or holds values that are not finite.
    """
    for name, region, least in (("tissue", tissue, 1), ("air", air, 2)):
        if region.size < least or not np.isfinite(region).all():
            raise QueryError(f"snr_db: expected at least {least} finite intensities of {name}, got {region.size}")
    return snr_from_moments_db(float(np.mean(tissue, dtype=np.float64)), float(np.var(air, dtype=np.float64)))


def snr_from_moments_db(tissue_mean: float, air_variance: float) -> float:
    """Return the SNR of `snr_db` in dB from the mean of tissue and the variance of air, which sum up over a volume."""
    if tissue_mean == 0.0:
        return -math.inf
    return math.inf if air_variance == 0.0 else 10.0 * math.log10(tissue_mean**2 / air_variance)


def edge_preservation_index(reference: NDArray[Any], test: NDArray[Any]) -> float:
    """Edge preservation index of a B-scan or a region of one: how much of the axial variation is left.

    EPI = sum |test(i+1, j) - test(i, j)| / sum |reference(i+1, j) - reference(i, j)|, i the axial index: the ratio
    of axial variation. 1 means edges as strong as the reference's, less means softer ones, more means sharper or
    noisier ones. This is our choice among the definitions in use, not known to be the paper's: it cites Ma et al.
    (2018), whose formula we have not found. The ratio is compatible with the values above 1 in the paper's table (1.048
    and 1.058), which the correlation of the two images after a Laplacian (Sattar et al. 1997) cannot reach.

    Args:
        reference: intensities [axial, lateral], at least two rows.
        test: intensities of the same shape.

    Raises:
        QueryError: the shapes differ, there are no two rows, or the reference has no axial variation at all.
    """
    if reference.shape != test.shape or reference.ndim != 2 or reference.shape[0] < 2 or reference.shape[1] < 1:
        raise QueryError(
            "edge_preservation_index: expected two images [axial, lateral] of one shape and at least two rows, "
            f"got {reference.shape} and {test.shape}"
        )
    before, after = (float(np.abs(np.diff(image.astype(np.float64), axis=0)).sum()) for image in (reference, test))
    if not (math.isfinite(before) and math.isfinite(after) and before > 0.0):
        raise QueryError(
            "edge_preservation_index: expected finite images and a reference that varies along the beam, "
            f"got axial variations of {before:g} and {after:g}; choose a region with an edge in it"
        )
    return after / before
