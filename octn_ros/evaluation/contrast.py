"""SNR and edge preservation of whole volumes, summed up B-scan by B-scan, and the surface that SNR goes by."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from octn_ros.evaluation.slabs import slab_volume, slabs
from octn_ros.metrics import air_and_tissue, snr_from_moments_db
from octn_ros.query import native_surface
from octn_ros.volume import Volume, gaussian_filter

_SIGMA_VOXELS = 2.0
_HALO_BSCANS = 8  # where scipy cuts that Gaussian off
_MEDIAN = 9  # A-scans along both lateral axes


def typical_surface(volume: Volume) -> NDArray[np.float64]:
    """Return the axial index of the surface [bscan, lateral], where most of its neighbourhood has it.

    What is judged as air or tissue must not follow speckle or an artefact of the scanner's first rows, so falls do not
    count here and neighbours outvote single A-scans. Works in slabs of 8 million voxels.

    Args:
        volume: the measured scan.

    Raises:
        QueryError: no A-scan has a difference at all.
    """
    bscans, _, laterals = volume.geometry.shape
    depth = np.empty((bscans, laterals))
    for first, last, halo in slabs(volume.geometry.shape, _HALO_BSCANS):
        slab = slab_volume(volume, volume.normalized(halo))
        points = native_surface(gaussian_filter(slab, _SIGMA_VOXELS), rises_only=True)
        index = slab.geometry.metric_to_voxel(points)[:, 1].reshape(halo.stop - halo.start, laterals)
        depth[first:last] = index[first - halo.start : last - halo.start]
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
