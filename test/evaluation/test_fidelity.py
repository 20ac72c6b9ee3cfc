"""A field against its scan: figures that can be worked out beforehand."""

import math

import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.evaluation import SURFACE_VARIANTS, assess_field, compare_on_grid, fractional_psnr_db
from octn_ros.evaluation.bscan_picture import fidelity_picture
from octn_ros.field import InterpolatedField
from octn_ros.metrics import RegionOfInterest
from octn_ros.volume import Volume

SPACING_M = (30e-6, 10e-6, 20e-6)
SHAPE = (9, 96, 24)
EDGE = 50  # first bright row


def half_space(edge=EDGE, shape=SHAPE, noise=0.0):
    """Dark above a bright half space; the noise is uniform, so that nothing is clipped."""
    generator = np.random.default_rng(3)
    array = np.full(shape, 0.2, np.float32)
    array[:, edge:] = 0.7
    return Volume.from_array(array + noise * generator.uniform(-1, 1, shape).astype(np.float32), SPACING_M)


def test_a_field_through_the_voxels_is_faithful_to_them():
    volume = half_space(noise=0.05)
    fidelity = assess_field(InterpolatedField(volume), volume)
    assert fidelity.grid.psnr_db > 100
    assert fidelity.grid.ssim == pytest.approx(1.0, abs=1e-6)
    assert min(fidelity.fractional_db.values()) > 100
    for distance in fidelity.grid.surfaces.values():
        assert distance.hausdorff_m == pytest.approx(0.0, abs=1e-9)
    whole, *regions = fidelity.regions
    assert whole.region is None
    assert [entry.region.kind for entry in regions] == ["air", "tissue", "boundary"]
    assert all(entry.epi == pytest.approx(1.0, abs=1e-5) for entry in regions)
    assert regions[1].snr_field_db == pytest.approx(regions[1].snr_volume_db, abs=1e-4)


def test_global_figures_by_hand():
    # The other volume's edge lies 4 rows deeper: 4 of 96 rows differ by 0.5, the mean squared error is 0.25 * 4 / 96.
    # Both surfaces are planes 4 rows of 10 um apart: Chamfer and Hausdorff distance are both 40 um.
    result, truth = compare_on_grid(InterpolatedField(half_space()), [half_space(EDGE + 4), half_space()])
    assert result.psnr_db == pytest.approx(-10 * math.log10(0.25 * 4 / 96), abs=1e-4)
    assert truth.psnr_db > 100
    assert set(result.surfaces) == set(SURFACE_VARIANTS)
    for distance in result.surfaces.values():
        assert distance.chamfer_m == pytest.approx(40e-6, rel=1e-6)
        assert distance.hausdorff_m == pytest.approx(40e-6, rel=1e-6)
    # Eq. 3's first difference lies between the last dark and the first bright row.
    np.testing.assert_allclose(result.field_surface[0], EDGE - 0.5)


def test_global_snr_and_epi_by_hand():
    # Air is 0.1 and 0.3 in turns (variance 0.01) in B-scans, tissue 0.7: 10 log10(0.49 / 0.01). In the field air is
    # 0.15 and 0.25 (variance 0.0025). Axially both vary by their step alone, 0.5 on average; the field's tissue is
    # brighter in one of nine B-scans by 0.09: on average 0.71 and 0.51.
    volume, smoother = half_space().array.copy(), half_space().array.copy()
    volume[:, :EDGE, ::2], volume[:, :EDGE, 1::2] = 0.1, 0.3
    smoother[:, :EDGE, ::2], smoother[:, :EDGE, 1::2] = 0.15, 0.25
    smoother[8, EDGE:] += 0.09
    field = InterpolatedField(Volume.from_array(smoother, SPACING_M))
    grid = assess_field(field, Volume.from_array(volume, SPACING_M)).grid
    assert grid.snr_volume_db == pytest.approx(10 * math.log10(0.49 / 0.01), abs=1e-4)
    assert grid.snr_field_db == pytest.approx(10 * math.log10(0.71**2 / 0.0025), abs=1e-3)
    assert grid.epi == pytest.approx(0.51 / 0.5, abs=1e-4)
    np.testing.assert_allclose(grid.typical_surface, EDGE - 0.5)


def test_without_room_for_air_there_is_no_global_snr():
    volume = half_space(edge=5)
    assert math.isnan(compare_on_grid(InterpolatedField(volume), [volume])[0].snr_volume_db)


def test_slabs_do_not_change_the_figures(monkeypatch):
    volume, field = half_space(EDGE + 1, noise=0.3), InterpolatedField(half_space(noise=0.3))
    whole, shares = compare_on_grid(field, [volume])[0], []
    monkeypatch.setattr("octn_ros.evaluation.slabs._SLAB_VOXELS", 2 * SHAPE[1] * SHAPE[2])
    sliced = compare_on_grid(field, [volume], shares.append)[0]
    assert shares == pytest.approx([2 / 9, 4 / 9, 6 / 9, 8 / 9, 1.0])
    assert (sliced.psnr_db, sliced.ssim) == (pytest.approx(whole.psnr_db), pytest.approx(whole.ssim))
    assert (sliced.snr_field_db, sliced.epi) == (pytest.approx(whole.snr_field_db), pytest.approx(whole.epi))
    np.testing.assert_array_equal(sliced.typical_surface, whole.typical_surface)
    np.testing.assert_array_equal(sliced.volume_surface, whole.volume_surface)
    np.testing.assert_array_equal(sliced.field_surface, whole.field_surface)


@pytest.mark.parametrize(("bscans", "anchor"), [(8, 4), (9, 4), (2, 0), (3, 1)])
def test_fractional_slices_lie_between_the_papers_anchors(bscans, anchor):
    volume = half_space(shape=(bscans, 16, 16), edge=8, noise=0.1)
    figures = fractional_psnr_db(InterpolatedField(volume), volume)
    assert list(figures) == pytest.approx([anchor + 0.25, anchor + 0.5, anchor + 0.75])


def test_snr_of_a_region_by_hand():
    # Air alternates between 0.1 and 0.3 (variance 0.01), tissue is 0.7: 10 log10(0.49 / 0.01).
    array = half_space().array.copy()
    array[:, :EDGE:2], array[:, 1:EDGE:2] = 0.1, 0.3
    volume = Volume.from_array(array, SPACING_M)
    regions = (
        RegionOfInterest("up", "air", (0, 20), (0, 24)),
        RegionOfInterest("R1", "tissue", (60, 80), (0, 24)),
    )
    _, air, tissue = assess_field(InterpolatedField(volume), volume, regions=regions).regions
    assert tissue.snr_volume_db == pytest.approx(10 * math.log10(49.0), abs=1e-4)
    assert math.isnan(air.snr_volume_db)
    assert math.isnan(tissue.epi)  # nothing varies there
    assert math.isnan(tissue.surface.chamfer_m)  # no surface there


def test_another_grid_is_refused():
    field = InterpolatedField(half_space())
    for volume in (
        half_space(shape=(9, 96, 25)),
        Volume.from_array(half_space().array, (31e-6, 10e-6, 20e-6)),
    ):
        with pytest.raises(QueryError, match="expected a volume on the field's grid"):
            assess_field(field, volume)


def test_the_picture_is_a_png():
    volume = half_space(noise=0.1)
    content = fidelity_picture(assess_field(InterpolatedField(volume), volume), volume.geometry)
    assert content.startswith(b"\x89PNG")
    assert len(content) > 10_000
