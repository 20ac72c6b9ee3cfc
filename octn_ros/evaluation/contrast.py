"""SNR and edge preservation of whole volumes, summed up B-scan by B-scan, and the surface that SNR goes by."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.metrics import air_and_tissue, snr_from_moments_db
from octn_ros.query import native_surface
from octn_ros.volume import Volume, gaussian_filter

_SIGMA_VOXELS = 2.0
_HALO_BSCANS = 8  # where scipy cuts that Gaussian off
_MEDIAN = 9  # A-scans along both lateral axes
_SLAB_VOXELS = 1 << 23


def typical_surface(volume: Volume) -> NDArray[np.float64]:
    """Return the axial index of the surface [bscan, lateral], where most of its neighbourhood has it.

    What is judged as air or tissue must not follow speckle or an artefact of the scanner's first rows, so falls do not
    count here and neighbours outvote single A-scans. Works in slabs of 8 million voxels.

    Args:
        volume: the measured scan.

    Raises:
        QueryError: no A-scan has a difference at all.
    """
    bscans, axials, laterals = volume.geometry.shape
    depth = np.empty((bscans, laterals))
    step = max(1, _SLAB_VOXELS // (axials * laterals))
    for first in range(0, bscans, step):
        last = min(first + step, bscans)
        # A slab has at least the two B-scans that a geometry needs, thanks to its halo.
        start, stop = max(0, first - _HALO_BSCANS), min(bscans, last + _HALO_BSCANS)
        intensity = volume.normalized(slice(start, stop))
        geometry = replace(volume.geometry, shape=intensity.shape)
        slab = replace(volume, array=intensity, geometry=geometry, intensity_range=(0.0, 1.0))
        points = native_surface(gaussian_filter(slab, _SIGMA_VOXELS), rises_only=True)
        index = geometry.metric_to_voxel(points)[:, 1].reshape(stop - start, laterals)
        depth[first:last] = index[first - start : last - start]
    typical: NDArray[np.float64] = ndimage.median_filter(depth, size=_MEDIAN, mode="nearest")
    return typical


class Contrast:
    """Sums for the SNR and the axial variation of one volume, filled B-scan by B-scan.

    Args:
        surface_voxels: axial index of the surface [bscan, lateral], which tells air from tissue.
    """

    def __init__(self, surface_voxels: NDArray[np.float64]) -> None:
        self._surface = surface_voxels
        self._tissue = np.zeros(2)  # number of voxels, sum
        self._air = np.zeros(3)  # number of voxels, sum, sum of squares
        self.variation = 0.0

    def add(self, bscan: int, intensity: NDArray[np.float32]) -> None:
        """Count in the intensities [axial, lateral] of B-scan number `bscan`."""
        values = intensity.astype(np.float64)
        air, tissue = (values[mask] for mask in air_and_tissue(self._surface[bscan], len(values)))
        self._tissue += np.array([tissue.size, tissue.sum()])
        self._air += np.array([air.size, air.sum(), np.vdot(air, air)])
        self.variation += float(np.abs(np.diff(values, axis=0)).sum())

    @property
    def snr_db(self) -> float:
        """SNR in dB as `metrics.snr_db` defines it; NaN where there is no room for air or tissue."""
        if self._tissue[0] == 0 or self._air[0] < 2:
            return math.nan
        mean = self._air[1] / self._air[0]
        variance = max(0.0, self._air[2] / self._air[0] - mean**2)
        return snr_from_moments_db(float(self._tissue[1] / self._tissue[0]), float(variance))

    def edge_preservation(self, reference: Contrast) -> float:
        """Return the edge preservation index over all B-scans against `reference`; NaN if that does not vary."""
        return self.variation / reference.variation if reference.variation > 0 else math.nan
