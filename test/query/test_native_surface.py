import sys

import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.query import native_surface
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import Volume, gaussian_filter

SPACING_M = (28e-6, 14.59e-6, 14e-6)


def test_one_point_for_each_a_scan_half_way_between_the_two_voxels_that_differ_most():
    voxels = np.full((2, 6, 3), 0.2, dtype=np.float32)
    for (bscan, lateral), first_bright in np.ndenumerate(np.array([[1, 2, 3], [4, 5, 1]])):
        voxels[bscan, first_bright:, lateral] = 0.9
    points = native_surface(Volume.from_array(voxels, SPACING_M, origin_m=(1.0, 2.0, 3.0)))
    lateral, bscan = np.tile(np.arange(3), 2), np.repeat(np.arange(2), 3)
    depth = np.array([0.5, 1.5, 2.5, 3.5, 4.5, 0.5])
    expected = [1 + lateral * SPACING_M[2], 2 + bscan * SPACING_M[0], 3 + depth * SPACING_M[1]]
    np.testing.assert_allclose(points, np.transpose(expected), rtol=0, atol=1e-12)


def test_falls_count_as_in_the_paper_unless_rises_are_asked_for():
    profile = np.array([0.1, 0.5, 0.5, 0.0, 0.0], dtype=np.float32)
    volume = Volume.from_array(np.broadcast_to(profile[None, :, None], (2, 5, 2)).copy(), (1.0, 1.0, 1.0))
    assert set(native_surface(volume)[:, 2]) == {2.5}
    assert set(native_surface(volume, rises_only=True)[:, 2]) == {0.5}


def test_slabs_leave_no_seam(monkeypatch):
    volume = Volume.from_array(np.random.default_rng(0).random((7, 9, 5), dtype=np.float32), SPACING_M)
    whole = native_surface(volume)
    monkeypatch.setattr(sys.modules[native_surface.__module__], "_SLAB_VOXELS", 100)
    np.testing.assert_array_equal(native_surface(volume), whole)


def test_on_a_phantom_speckle_misleads_it_and_a_filter_mends_it():
    phantom = make_phantom(PhantomConfig(shape=(24, 96, 48), speckle="single-look", snr_db=15.0))

    def spread_m(volume):
        points = native_surface(volume, rises_only=True)
        error = points[:, 2] - phantom.surface_depth_m(points[:, 0], points[:, 1])
        return np.sqrt(np.mean((error - np.median(error)) ** 2))

    assert spread_m(phantom.volume) > 10 * SPACING_M[1]
    filtered = gaussian_filter(phantom.volume, 2.0)
    assert spread_m(filtered) < 2 * SPACING_M[1]
    assert spread_m(phantom.truth) < 0.5 * SPACING_M[1]


def test_a_volume_that_is_constant_along_the_beam():
    voxels = np.broadcast_to(np.random.default_rng(0).random((3, 1, 4), dtype=np.float32), (3, 5, 4)).copy()
    with pytest.raises(QueryError, match="change along the beam, got none"):
        native_surface(Volume.from_array(voxels, SPACING_M))
