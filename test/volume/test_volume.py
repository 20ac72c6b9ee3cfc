import numpy as np
import pytest

from octn_ros.errors import ConfigurationError, VolumeError
from octn_ros.volume import Volume, gaussian_filter

SPACING = (28e-6, 14.59e-6, 14e-6)


def ramp(dtype=np.uint8):
    return np.arange(4 * 5 * 6).reshape(4, 5, 6).astype(dtype)


def test_integers_use_the_range_of_their_type():
    volume = Volume.from_array(ramp(np.uint16), SPACING)
    assert volume.intensity_range == (0.0, 65535.0)
    np.testing.assert_allclose(volume.normalized(), ramp() / 65535.0, rtol=1e-6)


def test_stated_range_is_kept_and_values_outside_are_clipped():
    volume = Volume.from_array(ramp(), SPACING, intensity_range=(10, 50))
    assert volume.normalized().min() == 0.0
    assert volume.normalized().max() == 1.0
    assert volume.normalized().flat[30] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("values", "expected"), [(ramp(np.float64) / 200, (0.0, 1.0)), (ramp(np.float32) - 40, (-40.0, 79.0))]
)
def test_floats_keep_unit_range_or_use_their_own(values, expected):
    volume = Volume.from_array(values, SPACING)
    assert volume.intensity_range == expected
    assert volume.array.dtype == np.float32


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_voxels_that_are_not_finite_are_counted(bad):
    values = ramp(np.float32)
    values[1, 2, 3] = values[0, 0, 0] = bad
    with pytest.raises(VolumeError, match="got 2 NaN or infinite"):
        Volume.from_array(values, SPACING)


def test_constant_volume_is_refused():
    with pytest.raises(VolumeError, match="constant"):
        Volume.from_array(np.full((3, 3, 3), 7, np.uint8), SPACING)


@pytest.mark.parametrize("values", [np.zeros((3, 3)), np.zeros((3, 3, 3), complex), np.zeros((3, 3, 3), bool)])
def test_wrong_arrays_are_refused(values):
    with pytest.raises(VolumeError, match="expected"):
        Volume.from_array(values, SPACING)


def test_backwards_range_is_refused():
    with pytest.raises(VolumeError, match="low < high"):
        Volume.from_array(ramp(), SPACING, intensity_range=(5, 5))


def test_gaussian_filter_keeps_a_plane_and_calms_noise():
    rng = np.random.default_rng(0)
    noisy = Volume.from_array(rng.uniform(0, 1, (12, 12, 12)).astype(np.float32), SPACING, stamp_ns=5)
    calm = gaussian_filter(noisy)
    assert calm.normalized().std() < 0.3 * noisy.normalized().std()
    assert calm.normalized().mean() == pytest.approx(noisy.normalized().mean(), abs=0.02)
    assert (calm.stamp_ns, calm.geometry) == (5, noisy.geometry)
    with pytest.raises(ConfigurationError, match="above 0"):
        gaussian_filter(noisy, -1.0)
