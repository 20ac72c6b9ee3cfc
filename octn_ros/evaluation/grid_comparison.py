"""A field against whole volumes, B-scan by B-scan: PSNR, SSIM, SNR, EPI, surfaces of eq. 3, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.evaluation.contrast import Contrast, typical_surface
from octn_ros.evaluation.slabs import slab_volume, slabs
from octn_ros.field import Field
from octn_ros.metrics import SSIM_WINDOW, CloudDistance, cloud_distance, psnr_from_error_db, ssim
from octn_ros.query import native_surface
from octn_ros.query.lattice import canonical_index
from octn_ros.volume import Volume, gaussian_filter

Progress = Callable[[float], None]
# Eq. 3 on raw voxels picks speckle wherever that is steeper than the tissue's edge; after this Gaussian it finds it.
SURFACE_SIGMA_VOXELS = 1.0
SURFACE_VARIANTS = ("raw voxels", f"after a Gaussian of {SURFACE_SIGMA_VOXELS:g} voxel")
_HALO_BSCANS = 4  # where scipy cuts the Gaussian off


@dataclass(frozen=True, eq=False)
class GridComparison:
    """How a field agrees with one volume on its native grid.

    Attributes:
        psnr_db: over all voxels.
        ssim: mean over the B-scans; NaN where they are smaller than its window.
        snr_volume_db, snr_field_db: of all B-scans together, in the volume and in the field: tissue and air are the
            bands below and above the surface of the measured scan; NaN where there is no room for one.
        epi: edge preservation index of the field against the volume, over all B-scans together.
        surfaces: Chamfer and Hausdorff distance of the two surfaces, for each of `SURFACE_VARIANTS`.
        typical_surface: axial index of the measured scan's surface [bscan, lateral] that tells air from tissue.
        volume_surface: axial index of the volume's surface [variant, bscan, lateral].
        field_surface: axial index of the field's surface [variant, bscan, lateral].
    """

    psnr_db: float
    ssim: float
    snr_volume_db: float
    snr_field_db: float
    epi: float
    surfaces: dict[str, CloudDistance]
    typical_surface: NDArray[np.float64]
    volume_surface: NDArray[np.float64]
    field_surface: NDArray[np.float64]


def compare_on_grid(
    field: Field, volumes: Sequence[Volume], progress: Progress | None = None
) -> tuple[GridComparison, ...]:
    """Render a field at every voxel, once, and compare it with volumes of its geometry.

    Memory beyond the volumes stays at a few slabs of 8 million voxels. Thread-safe; any device.

    Args:
        field: the field.
        volumes: what it is held against, the measured scan first, then perhaps a noise-free one.
        progress: called with the share that is done.

    Raises:
        QueryError: a volume's shape or spacing is not the field's.
    """
    for volume in volumes:
        _check_same_grid(field, volume)
    shape = field.geometry.shape
    typical = typical_surface(volumes[0])
    sums = [_Sums(volume, typical) for volume in volumes]
    own, contrast = _Surfaces(shape), Contrast(typical)
    for first, last, halo in slabs(shape, _HALO_BSCANS):
        rendered = render_bscans(field, np.arange(halo.start, halo.stop))
        inner = slice(first - halo.start, last - halo.start)
        own.add(volumes[0], halo, first, last, rendered)
        for bscan, image in zip(range(first, last), rendered[inner], strict=True):
            contrast.add(bscan, image)
        for entry in sums:
            entry.add(halo, first, last, rendered[inner])
        if progress is not None:
            progress(last / shape[0])
    return tuple(entry.result(own, contrast) for entry in sums)


def render_bscans(field: Field, positions: NDArray[np.number]) -> NDArray[np.float32]:
    """Return the field's intensities [position, axial, lateral] at whole or fractional B-scan positions of its grid."""
    bscans, axials, laterals = field.geometry.shape
    lateral, axial, bscan = (
        canonical_index(index, count, field.device)
        for index, count in ((np.arange(laterals), laterals), (np.arange(axials), axials), (positions, bscans))
    )
    return field.lattice(lateral, axial, bscan).cpu().numpy()


def surface_points_m(volume: Volume, depth_voxels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a surface, given as axial indices [bscan, lateral], as points [N, 3] in metres of the OCT frame."""
    bscan, lateral = np.meshgrid(*(np.arange(n) for n in depth_voxels.shape), indexing="ij")
    index = np.stack([bscan, depth_voxels, lateral], axis=-1)
    points: NDArray[np.float64] = np.reshape(volume.geometry.voxel_to_metric(index.astype(np.float64)), (-1, 3))
    return points


class _Surfaces:
    """Axial index of the surface [variant, bscan, lateral] as slabs come in."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.depth = np.empty((len(SURFACE_VARIANTS), shape[0], shape[2]))

    def add(self, like: Volume, halo: slice, first: int, last: int, intensity: NDArray[np.float32]) -> None:
        slab = slab_volume(like, intensity)
        inner = slice(first - halo.start, last - halo.start)
        for variant, filtered in enumerate((slab, gaussian_filter(slab, SURFACE_SIGMA_VOXELS))):
            points = native_surface(filtered).reshape(intensity.shape[0], intensity.shape[2], 3)
            self.depth[variant, first:last] = slab.geometry.metric_to_voxel(points[inner])[..., 1]


class _Sums:
    """What one volume contributes, slab by slab."""

    def __init__(self, volume: Volume, typical_surface: NDArray[np.float64]) -> None:
        self._volume = volume
        self._typical, self._contrast = typical_surface, Contrast(typical_surface)
        self._squares, self._ssim = 0.0, 0.0
        self._surfaces = _Surfaces(volume.geometry.shape)

    def add(self, halo: slice, first: int, last: int, rendered: NDArray[np.float32]) -> None:
        measured = self._volume.normalized(halo)
        self._surfaces.add(self._volume, halo, first, last, measured)
        inner = measured[first - halo.start : last - halo.start]
        for bscan, one, other in zip(range(first, last), inner, rendered, strict=True):
            self._contrast.add(bscan, one)
            difference = one.astype(np.float64) - other
            self._squares += float(np.vdot(difference, difference))
            self._ssim += ssim(one, other) if min(one.shape) >= SSIM_WINDOW else np.nan

    def result(self, field_surfaces: _Surfaces, field_contrast: Contrast) -> GridComparison:
        mine, other = self._surfaces.depth, field_surfaces.depth
        distances = {
            name: cloud_distance(surface_points_m(self._volume, mine[i]), surface_points_m(self._volume, other[i]))
            for i, name in enumerate(SURFACE_VARIANTS)
        }
        return GridComparison(
            psnr_db=psnr_from_error_db(self._squares / self._volume.array.size),
            ssim=self._ssim / self._volume.geometry.shape[0],
            snr_volume_db=self._contrast.snr_db,
            snr_field_db=field_contrast.snr_db,
            epi=field_contrast.edge_preservation(self._contrast),
            surfaces=distances,
            typical_surface=self._typical,
            volume_surface=mine,
            field_surface=other,
        )


def _check_same_grid(field: Field, volume: Volume) -> None:
    mine, other = field.geometry, volume.geometry
    if not mine.same_grid(other):
        spacings = (", ".join(f"{s * 1e6:g}" for s in g.spacing_m) for g in (mine, other))
        raise QueryError(
            f"expected a volume on the field's grid, {mine.shape} voxels every {next(spacings)} um, got {other.shape} "
            f"voxels every {next(spacings)} um; compare a field with the scan it was fitted to"
        )
