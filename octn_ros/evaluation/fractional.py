"""B-scans between the two middle ones: where they lie, and what a field is held against there."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import Volume

Intensity = NDArray[np.float32]
QUARTERS = (0.25, 0.5, 0.75)


def anchor_bscan(volume: Volume) -> int:
    """Return the first of the paper's two anchors: D/2 for an even number D of B-scans, (D-1)/2 for an odd one.

    With two B-scans it is the first.
    """
    bscans = volume.geometry.shape[0]
    return min(bscans // 2, bscans - 2)


def proxy_bscans(volume: Volume, anchor: int) -> Intensity:
    """Return trilinear interpolation of the voxels at the three quarters after B-scan `anchor` [3, axial, lateral]."""
    before, after = volume.normalized(slice(anchor, anchor + 2))
    return np.stack([np.float32(1.0 - quarter) * before + np.float32(quarter) * after for quarter in QUARTERS])


def true_bscans(phantom: PhantomConfig, anchor: int) -> Intensity | None:
    """Return the noise-free tissue at the three quarters after B-scan `anchor` [3, axial, lateral].

    It is the truth of a phantom with four times the B-scans over the same extent, of the same tissue; every fourth of
    them is a B-scan of `phantom`. Tissue that moves has its own place in every B-scan and none between them: None.
    """
    spoil = phantom.artefacts
    if spoil.axial_jitter_m or spoil.lateral_jitter_m or spoil.jump_m:
        return None
    bscans, axials, laterals = phantom.shape
    bscan_m, axial_m, lateral_m = phantom.spacing_m
    dense = dataclasses.replace(
        phantom, shape=(4 * (bscans - 1) + 1, axials, laterals), spacing_m=(bscan_m / 4.0, axial_m, lateral_m)
    )
    between: Intensity = make_phantom(dense).truth.array[4 * anchor + 1 : 4 * anchor + 4]
    return between
