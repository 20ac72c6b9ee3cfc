"""A tissue phantom whose surface and noise-free intensity are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.simulation.interface import Interface
from octn_ros.simulation.phantom_config import PhantomConfig
from octn_ros.simulation.speckle import Speckle
from octn_ros.simulation.tissue import Tissue
from octn_ros.volume.volume import Volume

_SLAB_VOXELS = 1 << 20  # voxels worked on at a time, which bounds the memory for temporaries
_LEVELS = 512  # nodes of the table from mean power to expected display


@dataclass(frozen=True)
class Phantom:
    """A simulated C-scan with its truth; immutable and thread-safe.

    `truth`, `surface` and `artefact_mask` describe the scan as it was acquired: where the tissue moved between B-scans,
    they have moved with it. `surface_at_rest` is the tissue without that motion.

    Attributes:
        volume: the noisy scan, uint8, logarithmic.
        truth: the expectation of `volume.normalized()` over the speckle, float32 in [0, 1], same geometry.
        surface: the interface between air and tissue as the scan shows it.
        surface_at_rest: the interface without motion; equal to `surface` where nothing moved.
        tissue: what reflects the light.
        config: what it was made from.
    """

    volume: Volume
    truth: Volume
    surface: Interface
    surface_at_rest: Interface
    tissue: Tissue
    config: PhantomConfig

    def surface_depth_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the true depth z in metres at lateral `x_m` and bscan `y_m` of the OCT frame, broadcast together."""
        return self.surface.depth_at(x_m, y_m)

    def surface_point(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the true surface points [..., (x, y, z)] in metres, in the OCT frame."""
        return self.surface.point_at(x_m, y_m)

    def surface_normal(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the true unit normals [..., 3] into the tissue, in the OCT frame."""
        return self.surface.normal_at(x_m, y_m)

    def artefact_mask(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where an artefact hides or fakes the surface, at lateral `x_m` and bscan `y_m`, broadcast together."""
        return self.tissue.artefact_mask(x_m, y_m)


def make_phantom(config: PhantomConfig | None = None, crater_m: NDArray[np.floating] | None = None) -> Phantom:
    """Make the phantom that `config` describes, the default one if none is given; deterministic, NumPy and scipy only.

    Mean power = air + backscatter * exp(-2 mu d), d the depth below the surface, after an axial point spread; speckle
    multiplies it; the display is its level in dB over the dynamic range, clipped to [0, 1] and rounded to 8 bits.

    Args:
        config: what to make.
        crater_m: depth of tissue taken away at each A-scan [bscan, lateral], metres; None for whole tissue.

    Raises:
        ConfigurationError: the crater does not fit the phantom.
    """
    config = config or PhantomConfig()
    bscans, axials, laterals = config.shape
    tissue = Tissue(config, crater_m)
    speckle = Speckle.named(config.speckle, config.dynamic_range_db, config.grain_voxels)
    levels = np.linspace(config.air_level_db, tissue.brightest_db, _LEVELS)
    displays = speckle.expected_display(levels, config.dynamic_range_db)
    generator = np.random.default_rng(config.seed)

    noisy = np.empty(config.shape, dtype=np.uint8)
    truth = np.empty(config.shape, dtype=np.float32)
    step = max(1, _SLAB_VOXELS // (axials * laterals))
    for start in range(0, bscans, step):
        indices = np.arange(start, min(start + step, bscans))
        level = tissue.level_db(indices)
        truth[indices] = np.interp(level, levels, displays)
        level += speckle.draw_db(generator, level.shape)
        level /= np.float32(config.dynamic_range_db)
        noisy[indices] = np.rint(np.clip(level, 0.0, 1.0, out=level) * np.float32(255.0))

    volume = Volume(noisy, config.geometry, (0.0, 255.0), "log")
    truth_volume = Volume(truth, config.geometry, (0.0, 1.0), "log")
    return Phantom(volume, truth_volume, tissue.surface, tissue.surface_at_rest, tissue, config)
