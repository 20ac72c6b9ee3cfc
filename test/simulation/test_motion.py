import numpy as np
import pytest

from octn_ros.simulation import ArtefactConfig, PhantomConfig, make_phantom
from octn_ros.simulation.motion import Motion

SPACING_M = 28e-6


def test_jitter_has_its_standard_deviations_and_the_jump_lasts():
    motion = Motion.drawn(20000, SPACING_M, 5e-6, 7e-6, 0.0, seed=0)
    assert motion.axial_m.std() == pytest.approx(5e-6, rel=0.02)
    assert motion.lateral_m.std() == pytest.approx(7e-6, rel=0.02)
    assert abs(np.corrcoef(motion.axial_m[1:], motion.axial_m[:-1])[0, 1]) < 0.03
    jumped = Motion.drawn(300, SPACING_M, 0.0, 0.0, -40e-6, seed=0)
    after = int(np.flatnonzero(jumped.jumps_m)[0])
    assert 100 <= after < 200
    np.testing.assert_array_equal(jumped.axial_m, np.where(np.arange(300) < after, 0.0, -40e-6))


def test_mask_lies_between_the_two_bscans_of_the_jump():
    motion = Motion.drawn(30, SPACING_M, 1e-6, 0.0, 60e-6, seed=4)
    after = int(np.flatnonzero(motion.jumps_m)[0])
    place = np.array([after - 1.01, after - 1.0, after - 0.5, after, after + 0.01]) * SPACING_M
    np.testing.assert_array_equal(motion.across_jump(place), [False, True, True, True, False])
    assert not Motion.drawn(30, SPACING_M, 1e-6, 1e-6, 0.0, seed=4).across_jump(place).any()


def test_displacement_is_linear_between_bscans_and_constant_beyond():
    motion = Motion.drawn(10, SPACING_M, 5e-6, 7e-6, 0.0, seed=2)
    lateral, axial = motion.at(np.array([-1.0, 3.0, 3.5, 20.0]) * SPACING_M)
    np.testing.assert_allclose(axial, motion.axial_m[[0, 3, 3, 9]] + [0, 0, np.diff(motion.axial_m)[3] / 2, 0])
    assert lateral[1] == pytest.approx(motion.lateral_m[3])


def test_scan_shows_each_bscan_where_the_tissue_lay():
    still = PhantomConfig(shape=(24, 96, 48))
    moved = PhantomConfig(shape=(24, 96, 48), artefacts=ArtefactConfig(axial_jitter_m=9e-6, jump_m=50e-6))
    lateral = PhantomConfig(shape=(24, 96, 48), artefacts=ArtefactConfig(lateral_jitter_m=9e-6))
    phantom, rest = make_phantom(moved), make_phantom(still)
    x, y = np.arange(48) * 14e-6, (np.arange(24) * SPACING_M)[:, None]
    displacement = phantom.surface_depth_m(x, y) - rest.surface_depth_m(x, y)
    np.testing.assert_allclose(displacement, np.broadcast_to(phantom.tissue.motion.axial_m[:, None], (24, 48)))
    np.testing.assert_array_equal(phantom.surface_at_rest.depth_at(x, y), rest.surface_depth_m(x, y))
    sideways = make_phantom(lateral)
    shifted = x - sideways.tissue.motion.lateral_m[:, None]
    np.testing.assert_allclose(sideways.surface_depth_m(x, y), rest.surface_depth_m(shifted, y), rtol=0, atol=1e-15)
    # What the scan shows follows: the level where the surface lies is the same in every B-scan.
    edge = np.argmax(phantom.truth.array > 0.46, axis=1)
    assert np.abs(edge * 14.59e-6 - phantom.surface_depth_m(x, y)).max() < 1.5 * 14.59e-6
    assert np.abs(edge * 14.59e-6 - rest.surface_depth_m(x, y)).max() > 3.0 * 14.59e-6


def test_speckle_does_not_move():
    still, moved = (
        make_phantom(PhantomConfig(shape=(6, 60, 30), surface="flat", artefacts=artefacts))
        for artefacts in (ArtefactConfig(), ArtefactConfig(axial_jitter_m=5e-6))
    )
    np.testing.assert_array_equal(still.volume.array[:, :10], moved.volume.array[:, :10])
