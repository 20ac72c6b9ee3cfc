"""A tissue phantom whose surface and noise-free intensity are known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from octn_ros.errors import ConfigurationError
from octn_ros.settings import check_settings, setting
from octn_ros.simulation.speckle import Speckle
from octn_ros.simulation.surface import TissueSurface
from octn_ros.volume.geometry import VolumeGeometry
from octn_ros.volume.volume import Volume

# Layers that follow the surface: depth below it in metres, backscatter against the top layer in dB. The ramps between
# them are gentle, so that the largest axial gradient stays at the surface.
_LAYER_DEPTH_M = (200e-6, 260e-6, 480e-6, 540e-6, 950e-6, 1050e-6)
_LAYER_GAIN_DB = (0.0, -3.0, -3.0, 1.0, 1.0, -1.0)
# The inclusion: its centre and radii as shares of the volume along (lateral, bscan) and of the depth below the surface.
_INCLUSION_CENTRE = (0.70, 0.36, 0.30)
_INCLUSION_RADII = (0.10, 0.16, 0.13)
_INCLUSION_GAIN_DB = 8.0
_INCLUSION_RIM = 0.2  # share of the radius over which it fades
_SLAB_VOXELS = 1 << 20  # voxels worked on at a time, which bounds the memory for temporaries
_LEVELS = 512  # nodes of the table from mean power to expected display


@dataclass(frozen=True)
class PhantomConfig:
    """What a phantom is: a seed and a small configuration.

    Raises:
        ConfigurationError: a value is outside its range, or the surface leaves the volume.
    """

    shape: tuple[int, int, int] = setting(
        (128, 160, 256), "voxels along (bscan, axial, lateral)", unit="voxels", low=2, high=4096
    )
    spacing_m: tuple[float, float, float] = setting(
        (28e-6, 14.59e-6, 14e-6), "voxel spacing along (bscan, axial, lateral)", unit="m", low=1e-7, high=1e-3
    )
    surface: str = setting("wavy", "form of the tissue surface", choices=("flat", "tilted", "wavy"))
    surface_depth_m: float = setting(
        0.0, "depth of the surface at the centre; 0 puts it at a quarter of the axial range", unit="m", low=0.0
    )
    tilt_deg: float = setting(2.0, "tilt of a tilted or wavy surface", unit="deg", low=0.0, high=60.0)
    wave_amplitude_m: float = setting(80e-6, "height of the waves above the plane", unit="m", low=0.0)
    wave_period_m: float = setting(2e-3, "length of the longest wave", unit="m", low=1e-5)
    snr_db: float = setting(15.0, "mean power just below the surface over air", unit="dB", low=1.0, high=60.0)
    speckle: str = setting("averaged", "distribution of the speckle", choices=("single-look", "averaged"))
    grain_voxels: float = setting(0.0, "lateral correlation length of the speckle", unit="voxels", low=0.0, high=20.0)
    attenuation_per_m: float = setting(
        700.0, "attenuation coefficient per metre of optical path, passed twice", unit="1/m", low=0.0, high=20000.0
    )
    resolution_m: float = setting(
        20e-6, "axial point spread, full width at half maximum", unit="m", low=1e-6, high=1e-3
    )
    dynamic_range_db: float = setting(50.0, "display range from black to white", unit="dB", low=20.0, high=100.0)
    air_level_db: float = setting(12.0, "mean power of air above the display's black", unit="dB", low=0.0, high=100.0)
    asymmetric: bool = setting(True, "an off-centre bright inclusion, which tells mirrored axes apart")
    seed: int = setting(0, "seed of the speckle", low=0)

    def __post_init__(self) -> None:
        check_settings(self)
        geometry = VolumeGeometry(self.shape, self.spacing_m)
        width, length, depth = geometry.extent_m
        surface = self.true_surface()
        z = surface.depth_at(np.linspace(0.0, width, 200), np.linspace(0.0, length, 200)[:, None])
        if z.min() < 0.0 or z.max() > depth:
            raise ConfigurationError(
                f"PhantomConfig: expected a surface between 0 and {depth * 1e6:.0f} um, the axial range, got one from "
                f"{z.min() * 1e6:.0f} to {z.max() * 1e6:.0f} um; change surface_depth_m, tilt_deg or wave_amplitude_m, "
                "or add axial voxels"
            )

    @property
    def name(self) -> str:
        """The phantom's name: surface, speckle, grain, SNR and seed."""
        return f"{self.surface} {self.speckle} grain{self.grain_voxels:g} snr{self.snr_db:g} seed{self.seed}"

    def true_surface(self) -> TissueSurface:
        """Return the interface between air and tissue that this configuration describes."""
        width, length, range_m = VolumeGeometry(self.shape, self.spacing_m).extent_m
        depth, centre = self.surface_depth_m or range_m / 4.0, (width / 2.0, length / 2.0)
        if self.surface == "flat":
            return TissueSurface.flat(depth, centre)
        if self.surface == "tilted":
            return TissueSurface.tilted(depth, centre, self.tilt_deg)
        return TissueSurface.wavy(depth, centre, self.tilt_deg, self.wave_amplitude_m, self.wave_period_m)


@dataclass(frozen=True)
class Phantom:
    """A simulated C-scan with its truth; immutable and thread-safe.

    Attributes:
        volume: the noisy scan, uint8, logarithmic.
        truth: the expectation of `volume.normalized()` over the speckle, float32 in [0, 1], same geometry.
        surface: the interface between air and tissue.
        config: what it was made from.
    """

    volume: Volume
    truth: Volume
    surface: TissueSurface
    config: PhantomConfig

    def surface_depth_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the true depth z in metres at lateral `x_m` and bscan `y_m` of the OCT frame, broadcast together."""
        return self.surface.depth_at(x_m, y_m)

    def surface_normal(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the true unit normals [..., 3] into the tissue, in the OCT frame."""
        return self.surface.normal_at(x_m, y_m)


def make_phantom(config: PhantomConfig | None = None) -> Phantom:
    """Make the phantom that `config` describes, the default one if none is given; deterministic, NumPy only.

    Mean power = air + backscatter * exp(-2 mu d), d the depth below the surface, after an axial point spread; speckle
    multiplies it; the display is its level in dB over the dynamic range, clipped to [0, 1] and rounded to 8 bits.
    """
    config = config or PhantomConfig()
    bscans, axials, laterals = config.shape
    surface = config.true_surface()
    speckle = Speckle.named(config.speckle, config.dynamic_range_db, config.grain_voxels)
    levels = np.linspace(config.air_level_db, config.air_level_db + config.snr_db + 2 * _INCLUSION_GAIN_DB, _LEVELS)
    displays = speckle.expected_display(levels, config.dynamic_range_db)
    generator = np.random.default_rng(config.seed)

    noisy = np.empty(config.shape, dtype=np.uint8)
    truth = np.empty(config.shape, dtype=np.float32)
    step = max(1, _SLAB_VOXELS // (axials * laterals))
    for start in range(0, bscans, step):
        indices = np.arange(start, min(start + step, bscans))
        level = _level_db(config, surface, indices)
        truth[indices] = np.interp(level, levels, displays)
        level += speckle.draw_db(generator, level.shape)
        level /= np.float32(config.dynamic_range_db)
        noisy[indices] = np.rint(np.clip(level, 0.0, 1.0, out=level) * np.float32(255.0))

    geometry = VolumeGeometry(config.shape, config.spacing_m)
    volume = Volume(noisy, geometry, (0.0, 255.0), "log")
    return Phantom(volume, Volume(truth, geometry, (0.0, 1.0), "log"), surface, config)


def _level_db(config: PhantomConfig, surface: TissueSurface, indices: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the mean power above black in dB of the B-scans `indices`, [len(indices), axial, lateral]."""
    (d, h, w), (_, axials, laterals) = config.spacing_m, config.shape
    x, y, z = np.arange(laterals) * w, indices * d, np.arange(axials) * h
    below = (z[None, :, None] - surface.depth_at(x[None, :], y[:, None])[:, None, :]).astype(np.float32)

    # exp(-2 mu d) behind a sharp edge, convolved with a Gaussian of sigma, in closed form.
    sigma = config.resolution_m / math.sqrt(8.0 * math.log(2.0))
    loss = 2.0 * config.attenuation_per_m
    power = ndtr(below * np.float32(1.0 / sigma) - np.float32(loss * sigma))
    power *= np.exp(np.float32(0.5 * (loss * sigma) ** 2) - np.float32(loss) * below)
    power *= np.float32(10.0 ** (config.snr_db / 10.0) - 1.0)
    power *= 10.0 ** (np.interp(below, _LAYER_DEPTH_M, _LAYER_GAIN_DB).astype(np.float32) / np.float32(10.0))
    if config.asymmetric:
        power *= 1.0 + np.float32(10.0 ** (_INCLUSION_GAIN_DB / 10.0) - 1.0) * _inclusion(config, x, y, z)
    return np.float32(config.air_level_db) + np.float32(10.0) * np.log10(np.float32(1.0) + power)


def _inclusion(
    config: PhantomConfig, x: NDArray[np.floating], y: NDArray[np.floating], z: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return the share of inclusion, [0, 1], in the voxels [len(y), len(z), len(x)]: an ellipsoid with a soft rim."""
    width, length, depth = VolumeGeometry(config.shape, config.spacing_m).extent_m
    top = config.true_surface().depth_m
    axes = []
    for place, start, extent, centre, radius in zip(
        (x, y, z), (0.0, 0.0, top), (width, length, depth - top), _INCLUSION_CENTRE, _INCLUSION_RADII, strict=True
    ):
        axes.append((((place - start) / extent - centre) / radius).astype(np.float32) ** 2)
    distance = np.sqrt(axes[0][None, None, :] + axes[1][:, None, None] + axes[2][None, :, None])
    return np.clip((1.0 + _INCLUSION_RIM / 2.0 - distance) / np.float32(_INCLUSION_RIM), 0.0, 1.0)
