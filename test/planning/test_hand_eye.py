"""Calibrations with a known truth: exact without noise, as good as its noise with it, refused where undetermined."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octn_ros.errors import CalibrationError
from octn_ros.planning.hand_eye import hand_eye_from_points, hand_eye_from_poses
from octn_ros.planning.point_fit import fit_points
from octn_ros.planning.transforms import from_rotation, invert

FIDUCIAL = from_rotation(np.array([0.4, 0.1, 0.02]), Rotation.from_rotvec([0.2, 0.1, 0.3]).as_matrix())
HIGH = np.array([3e-3, 3e-3, 2e-3])


def a_truth(seed):
    generator = np.random.default_rng(seed)
    return from_rotation(generator.uniform(-0.15, 0.15, 3), Rotation.random(random_state=seed).as_matrix())


def scene(true, turns, places):
    """Poses of the arm that bring the fiducial to these places of the scan [N, 3], turned by these vectors [N, 3]."""
    ee2base = []
    for turn, place in zip(turns, places, strict=True):
        rotation = (Rotation.from_rotvec(turn) * Rotation.from_euler("x", np.pi)).as_matrix()
        ee2base.append(from_rotation(FIDUCIAL[:3, 3] - rotation @ (true[:3, :3] @ place + true[:3, 3]), rotation))
    ee2base = np.array(ee2base)
    return ee2base, invert(ee2base @ true) @ FIDUCIAL


def usual(seed, count=12):
    generator = np.random.default_rng(seed)
    return generator.normal(0.0, 0.15, (count, 3)), generator.uniform(0.0, 1.0, (count, 3)) * HIGH


def angle(a, b):
    return Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()


@pytest.mark.parametrize("seed", range(4))
def test_without_noise_all_three_are_exact(seed):
    true = a_truth(seed)
    ee2base, fiducial = scene(true, *usual(seed))
    for fit in (hand_eye_from_points(ee2base, fiducial[:, :3, 3]), hand_eye_from_poses(ee2base, fiducial)):
        np.testing.assert_allclose(fit.oct2ee, true, atol=1e-9)
        np.testing.assert_allclose(fit.fiducial_m, FIDUCIAL[:3, 3], atol=1e-9)
        assert fit.rms_m < 1e-9
    points = np.random.default_rng(seed).uniform(-1e-3, 1e-3, (5, 3))
    fit = fit_points(points, points @ true[:3, :3].T + true[:3, 3])
    np.testing.assert_allclose(fit.a2b, true, atol=1e-12)
    assert fit.left_out_rms_m < 1e-12


def test_a_fiducial_that_moves_in_one_plane_of_the_scan_will_do():
    true = a_truth(0)
    turns, places = usual(0)
    places[:, 2] = 1e-3
    ee2base, fiducial = scene(true, turns, places)
    np.testing.assert_allclose(hand_eye_from_points(ee2base, fiducial[:, :3, 3]).oct2ee, true, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_with_noise_residuals_are_the_noise_and_the_error_is_as_told(seed):
    generator, noise = np.random.default_rng(100 + seed), 5e-6
    true = a_truth(seed)
    ee2base, fiducial = scene(true, *usual(seed, 24))
    seen = fiducial[:, :3, 3] + noise * generator.standard_normal((24, 3))
    fit = hand_eye_from_points(ee2base, seen)
    assert 0.7 * noise < fit.rms_m / np.sqrt(3) < 1.3 * noise
    assert angle(fit.oct2ee, true) < 5 * fit.rotation_std_rad
    assert 0 < fit.rotation_std_rad < 5e-3
    turned = fiducial.copy()
    turned[:, :3, 3] = seen
    turned[:, :3, :3] = Rotation.from_rotvec(5e-4 * generator.standard_normal((24, 3))).as_matrix() @ turned[:, :3, :3]
    fit = hand_eye_from_poses(ee2base, turned)
    assert angle(fit.oct2ee, true) < 5 * fit.rotation_std_rad < 5e-3
    assert 2e-4 < np.sqrt(np.mean(fit.residual_rad**2)) < 2e-3


def test_one_bad_point_is_told_by_leaving_it_out():
    generator = np.random.default_rng(3)
    points = generator.uniform(0.0, 3e-3, (8, 3))
    matches = points + 1e-6 * generator.standard_normal((8, 3))
    matches[5] += (0.0, 3e-4, 0.0)
    fit = fit_points(points, matches)
    assert np.argmax(fit.left_out_m) == 5
    assert fit.left_out_m[5] > 2.9e-4 > fit.residual_m[5]
    assert fit.rms_m < fit.left_out_rms_m


def test_three_points_leave_none_out():
    fit = fit_points(np.eye(3) * 1e-3, np.eye(3) * 1e-3)
    assert np.isnan(fit.left_out_m).all()
    assert np.isnan(fit.left_out_rms_m)


def test_what_does_not_determine_a_transform():
    line = np.outer(np.linspace(0.0, 3e-3, 6), (1.0, 2.0, 0.5))
    with pytest.raises(CalibrationError, match="on one line"):
        fit_points(line, line)
    with pytest.raises(CalibrationError, match="at least 3 matched points, got 2"):
        fit_points(line[:2], line[:2])
    with pytest.raises(CalibrationError, match="finite"):
        fit_points(np.full((4, 3), np.nan), np.zeros((4, 3)))
    with pytest.raises(CalibrationError, match="matched points"):
        fit_points(np.zeros((4, 3)), np.zeros((5, 3)))
    true, (turns, places) = a_truth(0), usual(0)
    one_axis = turns * (0.0, 0.0, 1.0)
    for still in (np.zeros_like(turns), one_axis):
        ee2base, fiducial = scene(true, still, places)
        with pytest.raises(CalibrationError, match="about two axes"):
            hand_eye_from_points(ee2base, fiducial[:, :3, 3])
        with pytest.raises(CalibrationError, match="about two axes"):
            hand_eye_from_poses(ee2base, fiducial)
    ee2base, fiducial = scene(true, turns, np.tile(HIGH / 2, (12, 1)))
    with pytest.raises(CalibrationError, match="all corners of the scan"):
        hand_eye_from_points(ee2base, fiducial[:, :3, 3])
    with pytest.raises(CalibrationError, match="at least 4 poses of the arm, got 3"):
        hand_eye_from_points(ee2base[:3], fiducial[:3, :3, 3])
    with pytest.raises(CalibrationError, match="at least 3 poses of the arm, got 2"):
        hand_eye_from_poses(ee2base[:2], fiducial[:2])
    with pytest.raises(CalibrationError, match="for each of 12 poses"):
        hand_eye_from_poses(ee2base, fiducial[:5])
    with pytest.raises(CalibrationError, match="for each of 12 poses"):
        hand_eye_from_points(ee2base, fiducial[:5, :3, 3])
