"""The fields a raster is planned on: through the voxels or fitted, raw or after the paper's filters."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from octn_ros.evaluation.raster_config import RasterBenchConfig
from octn_ros.field import Field, InterpolatedField
from octn_ros.simulation import PhantomConfig, named_phantom
from octn_ros.training import PRESETS, fit
from octn_ros.volume import Volume, gaussian_filter_of_size, median_filter

# As measured, and after the paper's filters of size 3.
FILTERS = ("raw", "gaussian", "median")


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


def phantom_config(name: str, config: RasterBenchConfig, shape: tuple[int, int, int] | None = None) -> PhantomConfig:
    """Return the phantom of that name with the table's seeds, in the table's size unless a shape is given."""
    if shape is None:
        named = named_phantom(name)
        shape = (config.bscans or named.shape[0], named.shape[1], config.laterals or named.shape[2])
    return named_phantom(name, seed=config.seed, tissue_seed=config.seed, shape=shape)


def filtered(volume: Volume, name: str) -> FilteredVolume:
    """Return the volume after the filter of that name, with the time it took."""
    began = time.perf_counter()
    if name == "gaussian":
        volume = gaussian_filter_of_size(volume)
    elif name == "median":
        volume = median_filter(volume)
    return FilteredVolume(name, volume, time.perf_counter() - began)


def table_fields(
    volumes: Mapping[str, FilteredVolume], device: str, config: RasterBenchConfig, phantom: str
) -> Iterator[NamedField]:
    """Yield the fields of one phantom, one after the other, so that a fit is not held longer than it is needed."""
    in_full = phantom in config.phantoms_in_full
    for name in FILTERS if in_full else ("gaussian",):
        yield NamedField(f"interpolated-{name}", InterpolatedField(volumes[name].volume, device), volumes[name])
    if in_full:
        voxels = volumes["gaussian"]
        yield NamedField("cubic-gaussian", InterpolatedField(voxels.volume, device, order="cubic"), voxels)
    fitted = FILTERS if in_full else ("raw",) if phantom in config.phantoms_fitted else ()
    for name in fitted:
        yield neural_field(volumes[name], device, config)


def neural_field(voxels: FilteredVolume, device: str, config: RasterBenchConfig) -> NamedField:
    """Fit the fast preset to a volume within the configured time."""
    settings = dataclasses.replace(PRESETS["fast"], time_budget_s=config.fit_s, seed=config.seed)
    return NamedField(f"neural-{voxels.name}", fit(voxels.volume, settings, device=device).field, voxels)
