"""The light that comes back from a slab of B-scans, for artefacts to add to and to take from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Light:
    """Mean reflected power of some B-scans over that of air, and where their voxels lie.

    Attributes:
        power: mean power over the air's [bscan, axial, lateral], linear, 0 in air; changed in place.
        below: depth of each voxel below the surface [bscan, axial, lateral], metres, negative in air.
        x: lateral place in the tissue's frame, metres, [bscan, lateral].
        y: bscan place in the tissue's frame, metres, [bscan, lateral].
        tissue_power: of the tissue at its surface over the air's, linear.
        sigma_m: standard deviation of the axial point spread, metres.
    """

    power: NDArray[np.float32]
    below: NDArray[np.float32]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    tissue_power: float
    sigma_m: float
