import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import LaserConfig, PhantomConfig, PhantomTissue

FLAT = PhantomConfig(shape=(60, 64, 100), surface="flat", surface_depth_m=3e-4)
TILTED = PhantomConfig(shape=(60, 128, 100), surface="tilted", tilt_deg=15.0)
LASER = LaserConfig()
DWELL_S = 20e-3
MIDDLE = np.array([0.7e-3, 0.83e-3])


def focus(config, place=MIDDLE, *degrees):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", degrees or (0, 0, 0), degrees=True).as_matrix()
    pose[:2, 3], pose[2, 3] = place, config.true_surface().depth_at(*place)
    return pose


def places(config):
    x = np.arange(config.shape[2]) * config.spacing_m[2]
    return x, np.arange(config.shape[0])[:, None] * config.spacing_m[0]


@pytest.mark.parametrize("config", [FLAT, TILTED])
def test_a_vertical_shot_leaves_the_crater_of_the_formula(config):
    tissue = PhantomTissue(config)
    volume = tissue.fire(focus(config), DWELL_S, LASER)
    x, y = places(config)
    expected = LASER.crater_m((x - MIDDLE[0]) ** 2 + (y - MIDDLE[1]) ** 2, DWELL_S)
    # On a slope the spot's far side is a little out of focus; the crater is cut off where it is a hundred-thousandth.
    np.testing.assert_allclose(tissue.removed_m, expected, atol=2e-5 * expected.max())
    assert volume == pytest.approx(float(LASER.removed_volume_m3(DWELL_S)), rel=1e-3)
    assert tissue.removed_volume_m3 == pytest.approx(volume)


def test_shots_add_up():
    once, twice = PhantomTissue(FLAT), PhantomTissue(FLAT)
    once.fire(focus(FLAT), 2 * DWELL_S, LASER)
    for _ in range(2):
        twice.fire(focus(FLAT), DWELL_S, LASER)
    # The second shot meets a deeper floor, a hundredth out of focus at most.
    np.testing.assert_allclose(twice.removed_m, once.removed_m, rtol=0.02, atol=1e-9)


@pytest.mark.parametrize("degrees", [(10, 0, 0), (0, 20, 0), (-8, 12, 30)])
def test_a_tilted_beam_takes_its_own_volume_from_a_slope_too(degrees):
    """Moving the surface along the beam sweeps the crater's volume, whatever the angles; the map keeps that."""
    tissue = PhantomTissue(TILTED)
    short = 2e-3  # shallow against the spot, where first order holds
    volume = tissue.fire(focus(TILTED, MIDDLE, *degrees), short, LASER)
    assert volume == pytest.approx(float(LASER.removed_volume_m3(short)), rel=0.02)


def test_a_beam_along_the_normal_of_a_slope_cuts_a_round_crater_into_it():
    tissue = PhantomTissue(TILTED)
    normal = TILTED.true_surface().normal_at(*MIDDLE)
    pose = focus(TILTED)
    pose[:3, :3] = Rotation.align_vectors([normal], [[0.0, 0.0, 1.0]])[0].as_matrix()
    tissue.fire(pose, 2e-3, LASER)
    x, y = places(TILTED)
    points = np.stack(np.broadcast_arrays(x, y, TILTED.true_surface().depth_at(x, y)), -1) - pose[:3, 3]
    across = np.linalg.norm(points - (points @ normal)[..., None] * normal, axis=-1)
    # Along the normal n the map falls by the crater over n_z.
    np.testing.assert_allclose(tissue.removed_m, LASER.crater_m(across**2, 2e-3) / normal[2], rtol=0.01, atol=1e-10)


def test_shots_beside_the_scan_and_from_below_take_nothing():
    tissue = PhantomTissue(FLAT)
    assert tissue.fire(focus(FLAT, np.array([0.1, 0.1])), DWELL_S, LASER) == 0.0
    assert tissue.fire(focus(FLAT, MIDDLE, 180, 0, 0), DWELL_S, LASER) == 0.0
    assert tissue.removed_m.max() == 0.0
    corner = tissue.fire(focus(FLAT, np.zeros(2)), DWELL_S, LASER)
    assert 0.2 < corner / float(LASER.removed_volume_m3(DWELL_S)) < 0.4, "what lies beyond the scan is not kept"


def test_a_scan_shows_the_crater_where_it_is_in_new_speckle():
    tissue = PhantomTissue(FLAT)
    before = tissue.scan(np.zeros(3))
    assert tissue.scan(np.zeros(3)) is before, "unchanged tissue is the same scan"
    tissue.fire(focus(FLAT), DWELL_S, LASER)
    after = tissue.scan(np.zeros(3))
    x, y = places(FLAT)
    np.testing.assert_allclose(after.surface_depth_m(x, y) - before.surface_depth_m(x, y), tissue.removed_m, atol=1e-12)
    assert not np.array_equal(after.volume.array[0], before.volume.array[0])
    np.testing.assert_array_equal(after.truth.array[0], before.truth.array[0])


def test_tissue_that_moved_is_scanned_where_it_is_with_its_crater():
    config = dataclasses.replace(FLAT, surface="tilted", tilt_deg=3.0)
    tissue = PhantomTissue(config)
    tissue.fire(focus(config), DWELL_S, LASER)
    shift = np.array([140e-6, -84e-6, 30e-6])
    moved = tissue.scan(shift)
    x, y = places(config)
    inside = (slice(10, -10), slice(20, -20))
    own = config.true_surface().depth_at(x - shift[0], y - shift[1]) + shift[2]
    gone = np.roll(tissue.removed_m, (-3, 10), axis=(0, 1))  # whole A-scans of the shift
    np.testing.assert_allclose(moved.surface_depth_m(x, y)[inside], (own + gone)[inside], atol=1e-9)
    with pytest.raises(ConfigurationError, match="surface between"):
        tissue.scan(np.array([0.0, 0.0, 5e-3]))
