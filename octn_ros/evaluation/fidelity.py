"""How faithful a field is to the scan it stands for: the figures of the paper's tables 3 and 4, in one object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.evaluation.fractional import QUARTERS, anchor_bscan, proxy_bscans
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
    surfaces = [_surface_in(region, grid, volume, bscan) for region in regions]
    return Fidelity(
        grid=grid,
        truth=comparisons[1] if truth is not None else None,
        bscan=bscan,
        regions=assess_regions(measured, rendered, regions, surfaces),
        fractional_db=fractional_psnr_db(field, volume),
        measured=measured,
        rendered=rendered,
    )


def assess_regions(
    measured: NDArray[np.float32],
    rendered: NDArray[np.float32],
    regions: Sequence[RegionOfInterest],
    surfaces: Sequence[CloudDistance] | None = None,
) -> tuple[RegionFidelity, ...]:
    """Compare a B-scan [axial, lateral] with a reference of the same shape, whole and in regions of interest.

    Args:
        measured: the reference; a noise-free one serves as well.
        rendered: what is judged.
        regions: where; those of air are the noise of every SNR.
        surfaces: distances of the surfaces within each region, NaN if left out.

    Returns:
        The whole B-scan first, then the regions.

    Raises:
        QueryError: a region lies outside the B-scan.
    """
    air = [region for region in regions if region.kind == "air"]
    noise = [
        np.concatenate([region.cut(image).ravel() for region in air]) if air else np.zeros(0)
        for image in (measured, rendered)
    ]
    whole = _figures(None, measured, rendered, noise, _NOWHERE)
    parts = [
        _figures(region, region.cut(measured), region.cut(rendered), noise, surface)
        for region, surface in zip(regions, surfaces or [_NOWHERE] * len(regions), strict=True)
    ]
    return whole, *parts


def fractional_psnr_db(field: Field, volume: Volume) -> dict[float, float]:
    """PSNR of the field between its two middle B-scans, against trilinear interpolation of the voxels.

    The paper's protocol: anchors (D/2, D/2 + 1) for an even number D of B-scans, ((D-1)/2, (D+1)/2) for an odd one,
    and steps of 0.25 between them. The interpolated B-scans stand in for a measurement that does not exist: a field
    that denoises is marked down for it.

    Returns:
        PSNR in dB by B-scan position.
    """
    anchor = anchor_bscan(volume)
    positions = anchor + np.array(QUARTERS)
    rendered = render_bscans(field, positions)
    return {
        float(position): psnr_db(proxy, image)
        for position, proxy, image in zip(positions, proxy_bscans(volume, anchor), rendered, strict=True)
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
