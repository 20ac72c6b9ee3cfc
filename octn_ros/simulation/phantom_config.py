"""What a phantom is: a seed and a small configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any

import numpy as np

from octn_ros.errors import ConfigurationError
from octn_ros.settings import check_settings, setting
from octn_ros.simulation.artefacts import ArtefactConfig
from octn_ros.simulation.surface import TissueSurface
from octn_ros.volume.geometry import VolumeGeometry

_CHECKED_PLACES = 200  # along each side, where the depth of the surface is held against the volume
_AIR_VOXELS = 10  # kept above the highest place of the surface where its depth is left open


@dataclass(frozen=True)
class PhantomConfig:
    """What a phantom is: a seed and a small configuration.

    The tissue is a function of place in metres. Two configurations that differ in `seed`, `rotation_deg` and `shift_m`
    alone describe the same tissue, seen in other speckle and from elsewhere.

    Raises:
        ConfigurationError: a value is outside its range, or the surface leaves the volume.
    """

    shape: tuple[int, int, int] = setting(
        (128, 160, 256), "voxels along (bscan, axial, lateral)", unit="voxels", low=2, high=4096
    )
    spacing_m: tuple[float, float, float] = setting(
        (28e-6, 14.59e-6, 14e-6), "voxel spacing along (bscan, axial, lateral)", unit="m", low=1e-7, high=1e-3
    )
    surface: str = setting(
        "wavy",
        "form of the tissue surface",
        choices=("flat", "tilted", "wavy", "rough", "stepped", "steep"),
    )
    surface_depth_m: float = setting(
        0.0,
        "depth of the surface at the centre; 0 puts it at a quarter of the axial range, or as deep as it must lie",
        unit="m",
        low=0.0,
    )
    tilt_deg: float = setting(2.0, "tilt of a tilted, wavy, rough or stepped surface", unit="deg", low=0.0, high=60.0)
    wave_amplitude_m: float = setting(80e-6, "height of the waves above the plane", unit="m", low=0.0)
    wave_period_m: float = setting(2e-3, "length of the longest wave, and of steep folds", unit="m", low=1e-5)
    roughness_m: float = setting(10e-6, "root mean square height of a rough surface", unit="m", low=0.0)
    roughness_correlation_m: float = setting(
        150e-6, "distance at which the correlation of roughness has fallen to 1/e", unit="m", low=1e-5
    )
    step_height_m: float = setting(150e-6, "height of the first step of a stepped surface", unit="m", low=0.0)
    step_rise_m: float = setting(20e-6, "lateral distance from 10 % to 90 % of a step", unit="m", low=1e-6)
    steepest_deg: float = setting(
        45.0, "slope that the flanks of a steep surface reach", unit="deg", low=0.0, high=60.0
    )
    rotation_deg: float = setting(
        0.0, "the tissue turned about the beam, from lateral towards bscan", unit="deg", low=-360.0, high=360.0
    )
    shift_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "the tissue shifted along (x, y, z), after the rotation", unit="m", low=-0.1, high=0.1
    )
    snr_db: float = setting(15.0, "mean power just below the surface over air", unit="dB", low=1.0, high=60.0)
    top_layer_db: float = setting(
        0.0, "backscatter of a top layer over the tissue below it; 0 for none", unit="dB", low=0.0, high=20.0
    )
    top_layer_m: float = setting(60e-6, "thickness of the top layer", unit="m", low=1e-6)
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
    tissue_seed: int = setting(0, "seed of roughness, of the places of artefacts and of motion", low=0)
    artefacts: ArtefactConfig = dataclass_field(default_factory=ArtefactConfig)

    def __post_init__(self) -> None:
        check_settings(self)
        depth = self.geometry.extent_m[2]
        top, bottom = self._depth_range(self.true_surface())
        if top < 0.0 or bottom > depth:
            raise ConfigurationError(
                f"PhantomConfig: expected a surface between 0 and {depth * 1e6:.0f} um, the axial range, got one from "
                f"{top * 1e6:.0f} to {bottom * 1e6:.0f} um; change surface_depth_m, tilt_deg or wave_amplitude_m, "
                "or add axial voxels"
            )

    @property
    def geometry(self) -> VolumeGeometry:
        """Shape and place of the scan."""
        return VolumeGeometry(self.shape, self.spacing_m)

    @property
    def name(self) -> str:
        """The phantom's name: surface, speckle, grain, SNR and seed, then every other setting that is no default."""
        named = f"{self.surface} {self.speckle} grain{self.grain_voxels:g} snr{self.snr_db:g} seed{self.seed}"
        told = {"surface", "speckle", "grain_voxels", "snr_db", "seed"}
        return " ".join([named, *(f"{key}={_brief(value)}" for key, value in _changed(self) if key not in told)])

    def tissue_surface(self) -> TissueSurface:
        """Return the interface between air and tissue in the tissue's own frame, neither turned nor shifted."""
        range_m = self.geometry.extent_m[2]
        if self.surface_depth_m:
            return self._surface_at(self.surface_depth_m)
        highest, _ = self._depth_range(self._surface_at(0.0))
        air = min(_AIR_VOXELS * self.spacing_m[1], range_m / 8.0)
        return self._surface_at(max(range_m / 4.0, air - highest))

    def true_surface(self) -> TissueSurface:
        """Return the interface between air and tissue that this configuration describes, in the OCT frame, at rest."""
        return self.tissue_surface().moved(self.rotation_deg, self.shift_m)

    def _surface_at(self, depth: float) -> TissueSurface:
        width, length, _ = self.geometry.extent_m
        centre, tilt = (width / 2.0, length / 2.0), self.tilt_deg
        if self.surface == "flat":
            return TissueSurface.flat(depth, centre)
        if self.surface == "tilted":
            return TissueSurface.tilted(depth, centre, tilt)
        if self.surface == "rough":
            correlation = self.roughness_correlation_m
            return TissueSurface.rough(depth, centre, tilt, self.roughness_m, correlation, self.tissue_seed)
        if self.surface == "stepped":
            return TissueSurface.stepped(depth, centre, tilt, self.step_height_m, self.step_rise_m)
        if self.surface == "steep":
            return TissueSurface.steep(depth, centre, self.steepest_deg, self.wave_period_m)
        return TissueSurface.wavy(depth, centre, tilt, self.wave_amplitude_m, self.wave_period_m)

    def _depth_range(self, surface: TissueSurface) -> tuple[float, float]:
        width, length, _ = self.geometry.extent_m
        x, y = np.linspace(0.0, width, _CHECKED_PLACES), np.linspace(0.0, length, _CHECKED_PLACES)[:, None]
        z = surface.depth_at(x, y)
        return float(z.min()), float(z.max())


def _changed(config: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of every setting that differs from its default, those of nested configurations too."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _changed(value)
        elif value != item.default:
            yield item.name, value


def _brief(value: Any) -> str:
    if isinstance(value, tuple):
        return "x".join(_brief(item) for item in value)
    return str(value) if isinstance(value, (bool, str)) else f"{value:.12g}"
