"""One of several candidate depths for each A-scan, so that the surface is smooth but may break."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A slope above this between neighbours costs no more: the surface may break there.
_BREAK_SLOPE = 2.0


def choose_smooth(
    depth: NDArray[np.integer],
    strength: NDArray[np.float32],
    slope_per_voxel: tuple[float, float],
    smoothness: float,
) -> NDArray[np.intp]:
    """Choose a candidate for each A-scan by semi-global matching (Hirschmueller 2008, with sparse labels).

    Minimises, along paths through the lattice in four directions that are summed, less the strength of what is chosen
    plus `smoothness` for every unit of slope between neighbours, up to a break. A path of neighbours thus outvotes an
    A-scan whose strongest candidate lies elsewhere, while a cliff costs a constant only.

    Args:
        depth: candidate depths [bscan, lateral, K] in voxels.
        strength: strength of each [bscan, lateral, K], usual ones about 1, impossible ones 0.
        slope_per_voxel: slope that a difference of one voxel means between neighbours along (bscan, lateral).
        smoothness: cost of a slope of 1.

    Returns:
        Index of the chosen candidate [bscan, lateral].
    """
    own = np.where(strength > 0, 1.0 - np.minimum(strength, 1.5), 1.5).astype(np.float32)
    place = depth.astype(np.float32)
    total = np.zeros_like(own)
    for axis in (0, 1):
        slope = np.float32(slope_per_voxel[axis])
        for backwards in (False, True):
            costs, places, sums = (np.moveaxis(a, axis, 0)[:: -1 if backwards else 1] for a in (own, place, total))
            path = costs[0]
            sums[0] += path
            for line in range(1, len(costs)):
                steep = np.abs(places[line][:, :, None] - places[line - 1][:, None, :]) * slope
                arriving = path[:, None, :] + np.float32(smoothness) * np.minimum(steep, np.float32(_BREAK_SLOPE))
                path = costs[line] + arriving.min(axis=-1) - path.min(axis=-1, keepdims=True)
                sums[line] += path
    return total.argmin(axis=-1)
