import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import bscan_slice, enface
from octn_ros.volume import Volume

VOXELS = np.random.default_rng(1).integers(0, 256, (5, 7, 6), dtype=np.uint8)


@pytest.fixture
def volume():
    return Volume.from_array(VOXELS, (1e-5, 1e-5, 1e-5))


def test_whole_positions_return_the_acquired_bscans(volume):
    field = InterpolatedField(volume)
    for index in range(5):
        image = bscan_slice(field, index)
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, VOXELS[index] / 255.0, atol=1e-5)


def test_fractional_positions_lie_between(volume):
    expected = (0.75 * VOXELS[2] + 0.25 * VOXELS[3]) / 255.0
    np.testing.assert_allclose(bscan_slice(InterpolatedField(volume), 2.25), expected, atol=1e-5)


@pytest.mark.parametrize("position", [-0.01, 4.01, float("nan"), float("inf")])
def test_positions_outside_the_scan(volume, position):
    with pytest.raises(QueryError, match="from 0 to 4, got"):
        bscan_slice(InterpolatedField(volume), position)


@pytest.mark.parametrize(("mode", "along_beam"), [("mip", np.max), ("mean", np.mean)])
def test_enface_of_volume_and_field(volume, mode, along_beam):
    expected = along_beam(VOXELS / 255.0, axis=1)
    view = enface(volume, mode)
    assert view.dtype == np.float32
    np.testing.assert_allclose(view, expected, atol=1e-6)
    np.testing.assert_allclose(enface(InterpolatedField(volume), mode), expected, atol=1e-5)


def test_unknown_view(volume):
    with pytest.raises(QueryError, match="mip or mean, got 'median'"):
        enface(volume, "median")
