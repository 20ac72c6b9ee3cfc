import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from octn_ros.errors import CalibrationError
from octn_ros.planning import from_translation_quaternion, invert, make_rigid, quaternions_xyzw
from octn_ros.planning.transforms import nearest_rotation

unit = st.floats(-1.0, 1.0, allow_subnormal=False)


@st.composite
def rigid(draw):
    quaternion = np.array([draw(unit) for _ in range(4)]) + np.array([0, 0, 0, 1e-3])
    quaternion = quaternion / np.linalg.norm(quaternion) if np.linalg.norm(quaternion) > 1e-6 else [0.0, 0.0, 0.0, 1.0]
    return from_translation_quaternion([draw(unit) for _ in range(3)], quaternion)


@given(rigid(), st.floats(-9e-4, 9e-4))
def test_a_nearly_rigid_matrix_is_made_exact_and_the_deviation_told(transform, error):
    given_matrix = transform.copy()
    given_matrix[0, 1] += error
    exact, deviation = make_rigid(given_matrix)
    np.testing.assert_allclose(exact[:3, :3].T @ exact[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(exact[:3, :3]) == pytest.approx(1.0)
    assert deviation <= abs(error) + 1e-12
    assert np.max(np.abs(exact[:3, :3] - given_matrix[:3, :3])) == pytest.approx(deviation, abs=1e-12)
    np.testing.assert_array_equal(exact[:3, 3], given_matrix[:3, 3])


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1.0, 1.0, 1.01, 1.0]), "within 0.001 of orthonormal"),
        (np.diag([1.0, 1.0, 1.0021, 1.0]), "within 0.001 of orthonormal"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "mirrored scan axis"),
        (np.diag([1000.0, 1000.0, 1000.0, 1.0]), "a scale in its spacing"),
        (np.zeros((4, 4)) + np.diag([0.0, 0.0, 0.0, 1.0]), "orthonormal"),
        (np.eye(3), r"4x4 numbers, got an array of shape \(3, 3\)"),
        (np.full((4, 4), np.nan), "finite numbers"),
        (np.eye(4) + np.eye(4, k=-3), "is it transposed"),
        ([[1, 2], [3]], "4x4 numbers"),
        ("eye", "4x4 numbers"),
    ],
)
def test_what_is_not_rigid_is_refused(matrix, words):
    with pytest.raises(CalibrationError, match=words):
        make_rigid(matrix)


@given(rigid(), rigid())
def test_inverse_of_one_and_of_many(a, b):
    many = np.stack([a, b])
    np.testing.assert_allclose(invert(many) @ many, np.broadcast_to(np.eye(4), (2, 4, 4)), atol=1e-9)
    np.testing.assert_array_equal(invert(many)[0], invert(a))


def test_quarter_turn_about_z_by_hand():
    a2b = from_translation_quaternion((1.0, 2.0, 3.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    np.testing.assert_allclose(a2b @ [1.0, 0.0, 0.0, 1.0], [1.0, 3.0, 3.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("translation", "quaternion"),
    [
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (0, 0, 0, 1.1)),
        ((0, 0, np.nan), (0, 0, 0, 1)),
        ((0, 0, 0), (0, 0, np.nan, 1)),
        ((0, 0), (0, 0, 0, 1)),
        ((0, (0, 0), 0), (0, 0, 0, 1)),
        ((0, 0, 0), "turned"),
    ],
)
def test_poses_that_are_none(translation, quaternion):
    with pytest.raises(CalibrationError, match="expected"):
        from_translation_quaternion(translation, quaternion)


def test_the_nearest_rotation_turns_matched_vectors_even_in_a_plane():
    turn = Rotation.from_rotvec((0.3, -0.8, 0.5)).as_matrix()
    vectors = np.random.default_rng(0).standard_normal((3, 7)) * ((1.0,), (2.0,), (0.0,))
    np.testing.assert_allclose(nearest_rotation(turn @ vectors @ vectors.T), turn, atol=1e-12)
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


def test_quaternions_do_not_flip_along_a_path():
    # One and a half turns about a skew axis: w passes through zero, where as_quat would change the sign.
    angles = np.linspace(0.0, 3 * np.pi, 200)
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * np.array([0.6, 0.0, 0.8])).as_matrix()
    quaternions = quaternions_xyzw(poses)
    assert np.all(np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0.99)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0)
    np.testing.assert_allclose(Rotation.from_quat(quaternions).as_matrix(), poses[:, :3, :3], atol=1e-12)
    assert quaternions[0, 3] >= 0
    assert quaternions_xyzw(poses[:0]).shape == (0, 4)


def test_quaternions_are_scipys_also_for_half_turns_about_any_axis() -> None:
    axes = Rotation.random(50, random_state=2).apply([0.0, 0.0, 1.0])
    half_turns = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), axes]))
    rotations = Rotation.concatenate([half_turns, Rotation.identity(), Rotation.random(500, random_state=1)])
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = rotations.as_matrix()
    quaternions, expected = quaternions_xyzw(poses), rotations.as_quat()
    np.testing.assert_allclose(np.abs(np.sum(quaternions * expected, axis=1)), 1.0, atol=1e-14)
    np.testing.assert_allclose(Rotation.from_quat(quaternions).as_matrix(), rotations.as_matrix(), atol=1e-14)
