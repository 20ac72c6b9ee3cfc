"""How faithful a field is to the scan it stands for: the figures of the paper's tables 3 and 4, in one object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.evaluation.grid_comparison import (
    GridComparison,
    Progress,
    compare_on_grid,
    render_bscans,
    surface_points_m,
)
from octn_ros.field import Field
from octn_ros.metrics import (
    SSIM_WINDOW,
    CloudDistance,
    RegionOfInterest,
    cloud_distance,
    edge_preservation_index,
    find_regions,
    psnr_db,
    snr_db,
    ssim,
)
from octn_ros.volume import Volume

_QUARTERS = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class RegionFidelity:
    """Figures of one region of the middle B-scan, or of all of it; NaN where a figure has no meaning.

    Attributes:
        region: where; None for the whole B-scan.
        psnr_db, ssim: of the field against the volume.
        snr_volume_db, snr_field_db: the region against all regions of air, in the volume and in the field.
        epi: edge preservation index of the field against the volume.
        surface: Chamfer and Hausdorff distance of the surfaces after a Gaussian, within the region.
    """

    region: RegionOfInterest | None
    psnr_db: float
    ssim: float
    snr_volume_db: float
    snr_field_db: float
    epi: float
    surface: CloudDistance


@dataclass(frozen=True, eq=False)
class Fidelity:
    """What `assess_field` found.

    Attributes:
        grid: against the measured volume, at every voxel.
        truth: the same against a noise-free volume, if one was given.
        bscan: index of the middle B-scan, where regions and pictures lie.
        regions: the whole B-scan first, then the regions.
        fractional_db: PSNR at fractional B-scan positions against trilinear interpolation of the voxels.
        measured, rendered: the middle B-scan [axial, lateral] in the volume and in the field.
    """

    grid: GridComparison
    truth: GridComparison | None
    bscan: int
    regions: tuple[RegionFidelity, ...]
    fractional_db: dict[float, float]
    measured: NDArray[np.float32]
    rendered: NDArray[np.float32]


def assess_field(
    field: Field,
    volume: Volume,
    *,
    truth: Volume | None = None,
    regions: Sequence[RegionOfInterest] | None = None,
    progress: Progress | None = None,
) -> Fidelity:
    """Compare a field with the volume it was fitted to; any device, bounded memory.

    Args:
        field: the field, neural or interpolated.
        volume: the measured scan.
        truth: a noise-free scan of the same geometry, if there is one.
        regions: regions of interest in the middle B-scan; found from its surface if left out.
        progress: called with the share that is done.

    Raises:
        QueryError: the geometries differ, or a region lies outside the B-scan.
    """
    comparisons = compare_on_grid(field, [volume] if truth is None else [volume, truth], progress)
    grid, bscan = comparisons[0], volume.geometry.shape[0] // 2
    measured = volume.normalized(slice(bscan, bscan + 1))[0]
    rendered = render_bscans(field, np.array([bscan]))[0]
    if regions is None:
        regions = find_regions(grid.typical_surface[bscan], (measured.shape[0], measured.shape[1]))
    air = [region for region in regions if region.kind == "air"]
    noise = [
        np.concatenate([region.cut(image).ravel() for region in air]) if air else np.zeros(0)
        for image in (measured, rendered)
    ]
    whole = _figures(None, measured, rendered, noise, _NOWHERE)
    parts = [
        _figures(region, region.cut(measured), region.cut(rendered), noise, _surface_in(region, grid, volume, bscan))
        for region in regions
    ]
    return Fidelity(
        grid=grid,
        truth=comparisons[1] if truth is not None else None,
        bscan=bscan,
        regions=(whole, *parts),
        fractional_db=fractional_psnr_db(field, volume),
        measured=measured,
        rendered=rendered,
    )


def fractional_psnr_db(field: Field, volume: Volume) -> dict[float, float]:
    """PSNR of the field between its two middle B-scans, against trilinear interpolation of the voxels.

    The paper's protocol: anchors (D/2, D/2 + 1) for an even number D of B-scans, ((D-1)/2, (D+1)/2) for an odd one,
    and steps of 0.25 between them. The interpolated B-scans stand in for a measurement that does not exist: a field
    that denoises is marked down for it.

    Returns:
        PSNR in dB by B-scan position.
    """
    bscans = volume.geometry.shape[0]
    anchor = min(bscans // 2 if bscans % 2 == 0 else (bscans - 1) // 2, bscans - 2)
    before, after = volume.normalized(slice(anchor, anchor + 2))
    positions = np.array([anchor + quarter for quarter in _QUARTERS])
    rendered = render_bscans(field, positions)
    return {
        float(position): psnr_db((1.0 - quarter) * before + quarter * after, image)
        for position, quarter, image in zip(positions, _QUARTERS, rendered, strict=True)
    }


_NOWHERE = CloudDistance(math.nan, math.nan)


def _figures(
    region: RegionOfInterest | None,
    measured: NDArray[np.float32],
    rendered: NDArray[np.float32],
    noise: Sequence[NDArray[np.floating]],
    surface: CloudDistance,
) -> RegionFidelity:
    # The noise is air's own; the whole B-scan is neither signal nor noise.
    signal = region is not None and region.kind != "air" and noise[0].size > 1
    try:
        epi = edge_preservation_index(measured, rendered)
    except QueryError:  # a region without axial variation has no edges to preserve
        epi = math.nan
    return RegionFidelity(
        region=region,
        psnr_db=psnr_db(measured, rendered),
        ssim=ssim(measured, rendered) if min(measured.shape) >= SSIM_WINDOW else math.nan,
        snr_volume_db=snr_db(measured, noise[0]) if signal else math.nan,
        snr_field_db=snr_db(rendered, noise[1]) if signal else math.nan,
        epi=epi,
        surface=surface,
    )


def _surface_in(region: RegionOfInterest, grid: GridComparison, volume: Volume, bscan: int) -> CloudDistance:
    clouds = []
    for depths in (grid.volume_surface, grid.field_surface):
        row = depths[-1, bscan]  # the last variant, after the Gaussian: raw voxels pick speckle
        inside = region.contains(row, np.arange(len(row), dtype=np.float64))
        clouds.append(surface_points_m(volume, row[None])[inside])
    return cloud_distance(clouds[0], clouds[1]) if all(len(cloud) for cloud in clouds) else _NOWHERE
