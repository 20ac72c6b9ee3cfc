"""What comes back from a phantom on average: surface, layers, inclusion, artefacts, as seen from the probe."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.errors import ConfigurationError
from octn_ros.simulation.artefacts import place_artefacts
from octn_ros.simulation.crater import AblatedSurface
from octn_ros.simulation.interface import Interface
from octn_ros.simulation.layers import axial_sigma_m, layered_power, tissue_over_air
from octn_ros.simulation.motion import Motion, ScannedSurface
from octn_ros.simulation.optics import Light
from octn_ros.simulation.phantom_config import PhantomConfig

# The inclusion: its centre and radii as shares of the volume along (lateral, bscan) and of the depth below the surface.
_INCLUSION_CENTRE = (0.70, 0.36, 0.30)
_INCLUSION_RADII = (0.10, 0.16, 0.13)
INCLUSION_GAIN_DB = 8.0
_INCLUSION_RIM = 0.2  # share of the radius over which it fades


class Tissue:
    """The mean reflected power of one phantom; immutable and thread-safe.

    Args:
        config: what it is.
        crater_m: depth taken away at each A-scan [bscan, lateral], metres; None for whole tissue. Layers, inclusion and
            artefacts stay where they were; light is lost below the new surface only.

    Attributes:
        surface: the interface as the scan shows it, motion and crater included.
        surface_at_rest: the same without motion.
        motion: of the tissue during the scan.

    Raises:
        ConfigurationError: the crater does not fit the phantom.
    """

    def __init__(self, config: PhantomConfig, crater_m: NDArray[np.floating] | None = None) -> None:
        self.config = config
        width, length, _ = config.geometry.extent_m
        spoil = config.artefacts
        self.motion = Motion.drawn(
            config.shape[0],
            config.spacing_m[0],
            spoil.axial_jitter_m,
            spoil.lateral_jitter_m,
            spoil.jump_m,
            config.tissue_seed,
        )
        self._own_surface = config.tissue_surface()
        self._before: Interface = config.true_surface()
        self.surface_at_rest = self._before if crater_m is None else self._ablated(np.asarray(crater_m, np.float64))
        moving = not self.motion.is_still
        self.surface = ScannedSurface(self.surface_at_rest, self.motion) if moving else self.surface_at_rest
        white_over_air = config.dynamic_range_db - config.air_level_db
        half_sides = (width / 2.0, length / 2.0)
        self._artefacts = place_artefacts(spoil, self._own_surface, half_sides, white_over_air, config.tissue_seed)

    @property
    def brightest_db(self) -> float:
        """A level above black that the mean power stays below, dB; beyond white where glare saturates the display."""
        config = self.config
        level = config.air_level_db + config.snr_db + config.top_layer_db + 2 * INCLUSION_GAIN_DB
        return max(level, config.dynamic_range_db + 30.0) if config.artefacts.glare_spots else level

    def artefact_mask(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where an artefact hides or fakes the surface, at broadcast x and y of the OCT frame, metres."""
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        mask = self.motion.across_jump(y)
        x, y = self._to_tissue(x - self.motion.at(y)[0], y)
        for artefact in self._artefacts:
            mask = mask | artefact.mask(x, y)
        return mask

    def level_db(self, indices: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the mean power above black in dB of the B-scans `indices`, [len(indices), axial, lateral]."""
        config, (d, h, w), (_, axials, laterals) = self.config, self.config.spacing_m, self.config.shape
        y, z = (indices * d)[:, None], np.arange(axials) * h
        lateral, axial = self.motion.at(y)
        x, z = np.arange(laterals) * w - lateral, z[None, :] - axial
        own = (z[:, :, None] - self._before.depth_at(x, y)[:, None, :]).astype(np.float32)
        below = own
        if isinstance(self.surface_at_rest, AblatedSurface):
            below = own - self.surface_at_rest.removed_at(x, y)[:, None, :].astype(np.float32)

        power = layered_power(config, below, own)
        own_x, own_y = self._to_tissue(x, np.broadcast_to(y, x.shape))
        if config.asymmetric:
            share = self._inclusion(own_x, own_y, z - config.shift_m[2])
            power *= 1.0 + np.float32(10.0 ** (INCLUSION_GAIN_DB / 10.0) - 1.0) * share
        light = Light(power, own, own_x, own_y, tissue_over_air(config), axial_sigma_m(config))
        for artefact in self._artefacts:
            artefact.apply(light)
        return np.float32(config.air_level_db) + np.float32(10.0) * np.log10(np.float32(1.0) + power)

    def _ablated(self, crater_m: NDArray[np.float64]) -> AblatedSurface:
        bscans, _, laterals = self.config.shape
        if crater_m.shape != (bscans, laterals):
            raise ConfigurationError(
                f"crater: expected a depth for each A-scan, shape ({bscans}, {laterals}), got {crater_m.shape}"
            )
        return AblatedSurface(self._before, crater_m, (self.config.spacing_m[0], self.config.spacing_m[2]))

    def _to_tissue(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return lateral places of the OCT frame in the tissue's own frame."""
        angle, (shift_x, shift_y, _) = math.radians(self.config.rotation_deg), self.config.shift_m
        if not (angle or shift_x or shift_y):
            return x, y
        centre_x, centre_y = self._own_surface.centre_m
        cos, sin = math.cos(angle), math.sin(angle)
        x, y = x - centre_x - shift_x, y - centre_y - shift_y
        return centre_x + cos * x + sin * y, centre_y + cos * y - sin * x

    def _inclusion(self, x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the share of inclusion, [0, 1], an ellipsoid with a soft rim.

        Args:
            x: lateral place [bscan, lateral] in the tissue's frame, metres.
            y: bscan place [bscan, lateral], likewise.
            z: axial place [bscan or 1, axial], likewise.

        Returns:
            Share of each voxel [bscan, axial, lateral].
        """
        width, length, depth = self.config.geometry.extent_m
        top = self._own_surface.depth_m
        axes = []
        for place, start, extent, centre, radius in zip(
            (x[:, None, :], y[:, None, :], z[:, :, None]),
            (0.0, 0.0, top),
            (width, length, depth - top),
            _INCLUSION_CENTRE,
            _INCLUSION_RADII,
            strict=True,
        ):
            axes.append((((place - start) / extent - centre) / radius).astype(np.float32) ** 2)
        distance = np.sqrt(axes[0] + axes[1] + axes[2])
        return np.clip((1.0 + _INCLUSION_RIM / 2.0 - distance) / np.float32(_INCLUSION_RIM), 0.0, 1.0)
