"""How noisy a C-scan is, estimated from itself."""

from __future__ import annotations

import torch

from octn_ros.errors import TrainingError
from octn_ros.training.sampling import ResidentVoxels

SAMPLES = 1 << 16  # the estimated variance has a standard error of about 1 %


def noise_variance(voxels: ResidentVoxels) -> float:
    """Estimate the variance of the noise in a C-scan's intensities, from each voxel and its two neighbours in bscan.

    2/3 of the mean of (v_k - (v_(k-1) + v_(k+1)) / 2)^2, after Gasser, Sroka and Jennen-Steinmetz, "Residual variance
    and residual pattern in nonlinear regression" (1986). Exact for tissue that changes linearly from B-scan to B-scan
    under noise that is independent from B-scan to B-scan, as speckle is at or below critical sampling. Tissue that
    changes faster counts as noise; noise that neighbouring B-scans share does not.

    Args:
        voxels: the C-scan, of at least 3 B-scans.

    Returns:
        The variance, in units of normalised intensity squared.

    Raises:
        TrainingError: there are fewer than 3 B-scans.
    """
    bscans, axials, laterals = voxels.geometry.shape
    if bscans < 3:
        raise TrainingError(
            f"expected at least 3 B-scans to estimate the noise from, got {bscans}; stop by steps instead"
        )
    plane = axials * laterals
    generator = torch.Generator().manual_seed(0)
    flat = torch.randint(plane, (bscans - 1) * plane, (SAMPLES,), generator=generator).to(voxels.device)
    residual = voxels.at(flat) - 0.5 * (voxels.at(flat - plane) + voxels.at(flat + plane))
    return float(residual.square().mean()) * 2.0 / 3.0
