import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import PhantomConfig, Scanner, make_phantom
from octn_ros.volume.volume import Volume


@pytest.fixture(scope="module")
def volume():
    return make_phantom(PhantomConfig(shape=(5, 60, 20))).volume


def test_bscans_come_in_order_with_their_own_stamps(volume):
    scans = list(Scanner(volume).bscans(1_000, 250))
    assert [scan.index for scan in scans] == [0, 1, 2, 3, 4]
    assert [scan.stamp_ns for scan in scans] == [1_000, 1_250, 1_500, 1_750, 2_000]
    np.testing.assert_array_equal(np.stack([scan.image for scan in scans]), volume.array)
    assert not scans[0].image.flags.writeable
    assert volume.array.flags.writeable


def test_pose_puts_each_pixel_where_the_volume_has_it():
    generator = np.random.default_rng(0)
    volume = Volume.from_array(generator.random((4, 6, 8)), (28e-6, 14.59e-6, 14e-6), origin_m=(1e-3, 2e-3, 3e-3))
    _, h, w = volume.geometry.spacing_m
    for scan in Scanner(volume).bscans(0, 0):
        assert np.linalg.det(scan.image2oct[:3, :3]) == pytest.approx(1.0)
        row, column = 3, 5
        place = scan.image2oct @ [column * w, row * h, 0.0, 1.0]
        expected = volume.geometry.voxel_to_metric(np.array([scan.index, row, column], dtype=float))
        np.testing.assert_allclose(place[:3], expected, atol=1e-15)


def test_image_z_runs_against_the_slow_axis(volume):
    first, second = list(Scanner(volume).bscans(0, 0))[:2]
    step = second.image2oct[:3, 3] - first.image2oct[:3, 3]
    np.testing.assert_allclose(first.image2oct[:3, :3].T @ step, [0, 0, -volume.geometry.spacing_m[0]], atol=1e-15)


def test_a_scanner_can_be_played_again(volume):
    scanner = Scanner(volume)
    assert len(list(scanner.bscans(0, 1))) == len(list(scanner.bscans(10, 1))) == 5


def test_negative_period_is_refused(volume):
    with pytest.raises(ConfigurationError, match="at least 0 ns, got -1 ns"):
        Scanner(volume).bscans(0, -1)


def test_a_sparse_scan_takes_every_so_many_th_bscan_in_as_much_less_time(volume):
    scanner = Scanner(volume, 2)
    assert (scanner.count, scanner.spacing_m) == (3, 2 * volume.geometry.spacing_m[0])
    scans = list(scanner.bscans(1_000, 250))
    assert [scan.index for scan in scans] == [0, 1, 2]
    assert [scan.stamp_ns for scan in scans] == [1_000, 1_250, 1_500]
    np.testing.assert_array_equal(np.stack([scan.image for scan in scans]), volume.array[::2])
    assert scans[2].image2oct[1, 3] == pytest.approx(4 * volume.geometry.spacing_m[0])
    for factor in (0, 5):
        with pytest.raises(ConfigurationError, match="factor of 1 to 4 for 5 B-scans"):
            Scanner(volume, factor)


def test_equal_scans_have_equal_hashes(volume):
    again = make_phantom(PhantomConfig(shape=(5, 60, 20))).volume
    assert Scanner(volume).content_hash == Scanner(again).content_hash
    other = make_phantom(PhantomConfig(shape=(5, 60, 20), seed=1)).volume
    hashes = {Scanner(volume).content_hash, Scanner(volume, 2).content_hash, Scanner(other).content_hash}
    assert len(hashes) == 3
