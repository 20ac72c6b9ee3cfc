"""The fields a raster is planned on: through the voxels or fitted, raw or after the paper's filters."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass

from octn_ros.evaluation.raster_config import RasterBenchConfig
from octn_ros.field import Field, InterpolatedField
from octn_ros.training import PRESETS, fit
from octn_ros.volume import Volume, gaussian_filter, gaussian_filter_of_size, median_filter

# As measured, after the paper's filters of size 3, and after a Gaussian of one voxel, which is a little wider.
FILTERS = ("raw", "gaussian", "median", "gaussian-1-voxel")
PAPER_FILTERS = FILTERS[:3]
_WIDE_SIGMA_VOXELS = 1.0


@dataclass(frozen=True, eq=False)
class FilteredVolume:
    """A volume before or after a filter.

    Attributes:
        name: one of `FILTERS`.
        volume: the voxels.
        seconds: what the filter took.
    """

    name: str
    volume: Volume
    seconds: float


@dataclass(frozen=True, eq=False)
class NamedField:
    """A field of the table.

    Attributes:
        name: "interpolated-gaussian", "neural-raw" and so on.
        field: the field.
        voxels: what it was made of.
    """

    name: str
    field: Field
    voxels: FilteredVolume


def filtered(volume: Volume, name: str) -> FilteredVolume:
    """Return the volume after the filter of that name, with the time it took."""
    began = time.perf_counter()
    if name == "gaussian":
        volume = gaussian_filter_of_size(volume)
    elif name == "median":
        volume = median_filter(volume)
    elif name == "gaussian-1-voxel":
        volume = gaussian_filter(volume, _WIDE_SIGMA_VOXELS)
    return FilteredVolume(name, volume, time.perf_counter() - began)


def interpolated_fields(volumes: dict[str, FilteredVolume], device: str, cubic: bool) -> Iterator[NamedField]:
    """Yield the trilinear field of each volume, and the cubic one of the Gaussian-filtered if `cubic`."""
    for voxels in volumes.values():
        yield NamedField(f"interpolated-{voxels.name}", InterpolatedField(voxels.volume, device), voxels)
    if cubic:
        voxels = volumes["gaussian"]
        yield NamedField("cubic-gaussian", InterpolatedField(voxels.volume, device, order="cubic"), voxels)


def neural_field(voxels: FilteredVolume, device: str, config: RasterBenchConfig) -> NamedField:
    """Fit the fast preset to a volume within the configured time."""
    settings = dataclasses.replace(PRESETS["fast"], time_budget_s=config.fit_s, seed=config.seed)
    return NamedField(f"neural-{voxels.name}", fit(voxels.volume, settings, device=device).field, voxels)
