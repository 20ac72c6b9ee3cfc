import numpy as np
import pytest

from octn_ros.evaluation.band_timing import middle_of, threshold_voxels, time_bands
from octn_ros.field import InterpolatedField
from octn_ros.query import PAPER_BANDS, BandIndex, Lattice, find_band
from octn_ros.volume import Volume, VolumeGeometry

GEOMETRY = VolumeGeometry((20, 24, 28), (28e-6, 14.59e-6, 14e-6), (1e-3, 0.0, 0.0))
LEVELS = np.random.default_rng(2).integers(0, 256, GEOMETRY.shape).astype(np.uint8)
VOLUME = Volume(LEVELS, GEOMETRY, (0.0, 255.0), "log")


def test_every_way_is_timed_and_the_field_asked_once():
    field = InterpolatedField(VOLUME)
    timings = time_bands(field, VOLUME, side_m=2e-4, repeats=2)
    assert [(band.low, band.high) for band in timings.bands] == [(0.2, 0.4), (0.4, 0.6), (0.6, 1.0)]
    assert [band.share for band in timings.bands] == pytest.approx([0.2, 0.2, 0.4], abs=0.02)
    assert all(min(band.indexed_s, band.exhaustive_s, band.numpy_s) > 0 for band in timings.bands)
    assert timings.ratio_lattice == min(band.exhaustive_s / band.indexed_s for band in timings.bands)
    assert timings.ratio_numpy == min(band.numpy_s / band.indexed_s for band in timings.bands)
    assert 4 * timings.voxels <= timings.index_bytes == BandIndex.of(field).nbytes
    assert timings.fill_s > 0


def test_numpy_lists_the_voxels_of_a_band():
    region = middle_of(GEOMETRY, 2e-4)
    lattice = Lattice.over(GEOMETRY, region, name="test")
    for query in PAPER_BANDS:
        points_m, values = threshold_voxels(VOLUME, query, lattice)
        expected = find_band(VOLUME, query, region)
        np.testing.assert_array_equal(points_m, expected.points_m)
        np.testing.assert_allclose(values / 255.0, expected.intensity, atol=1e-6)
        assert len(points_m) > 100
