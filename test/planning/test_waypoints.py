import numpy as np
import pytest

from octn_ros.errors import ConfigurationError, PlanError
from octn_ros.planning import WaypointConfig, inward_normals, rectangle_raster, waypoint_poses

RASTER = rectangle_raster((3e-4, 0.0), (7e-4, 5e-4))


def true_normals(field, points):
    x, y, h = points[:, 0], points[:, 1], 1e-7
    slope_x = (field.depth(x + h, y) - field.depth(x - h, y)) / (2 * h)
    slope_y = (field.depth(x, y + h) - field.depth(x, y - h)) / (2 * h)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@pytest.mark.parametrize(("radius", "degrees"), [(0.0, 0.5), (2.0, 10.0)])
def test_normals_of_known_surfaces(any_field, radius, degrees):
    points = np.column_stack([RASTER.points_m, any_field.depth(*RASTER.points_m.T)])
    normals = inward_normals(any_field, points, radius)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (normals[:, 2] > 0).all()
    angle = np.degrees(np.arccos(np.clip(np.sum(normals * true_normals(any_field, points), axis=1), -1.0, 1.0)))
    assert angle.max() < degrees


def test_a_flat_field_falls_back_to_the_beam(make_field):
    field = make_field(lambda x, y: 1e-3 + 0 * x)
    field.evaluate = lambda points: 0.5 + 0.0 * points.sum(dim=-1)
    np.testing.assert_array_equal(inward_normals(field, np.array([[5e-4, 0.0, 1e-3]])), [[0.0, 0.0, 1.0]])


def test_along_the_beam_a_waypoint_is_a_shift():
    poses = waypoint_poses(np.array([[1e-3, 2e-3, 3e-3]]), np.array([0.0, 0.0, 1.0]), 0.5e-3)
    expected = np.eye(4)
    expected[:3, 3] = (1e-3, 2e-3, 2.5e-3)  # towards the probe is up, against z
    np.testing.assert_allclose(poses, expected[None], atol=1e-15)


def test_poses_are_rigid_with_x_as_lateral_as_z_allows():
    rng = np.random.default_rng(0)
    z = rng.standard_normal((200, 3))
    z[:, 2] = np.abs(z[:, 2]) + 0.1
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    points = rng.standard_normal((200, 3))
    poses = waypoint_poses(points, z, -0.2)
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(rotation, 1, 2) @ rotation, np.tile(np.eye(3), (200, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    np.testing.assert_allclose(rotation[:, :, 2], z)
    np.testing.assert_allclose(poses[:, :3, 3], points + 0.2 * z)
    # The projection of the lateral axis on the plane across z is the best that z allows.
    best = np.array([1.0, 0.0, 0.0]) - z[:, :1] * z
    np.testing.assert_allclose(rotation[:, :, 0], best / np.linalg.norm(best, axis=1, keepdims=True), atol=1e-12)


@pytest.mark.parametrize(
    ("points", "z", "words"),
    [
        (np.zeros((2, 3)), np.array([[0, 0, 1.0], [0, 0, -1.0]]), "waypoint 1"),
        (np.zeros((2, 3)), np.array([0.0, 0.0, np.nan]), "into the tissue"),
        (np.zeros((2, 2)), np.array([0.0, 0.0, 1.0]), r"points \[N, 3\]"),
        (np.zeros((2, 3)), np.zeros((3, 3)), r"points \[N, 3\]"),
    ],
)
def test_axes_that_do_not_fit(points, z, words):
    with pytest.raises(PlanError, match=words):
        waypoint_poses(points, z, 0.0)


def test_settings_are_checked():
    with pytest.raises(ConfigurationError, match="expected one of beam, normal, got 'up'"):
        WaypointConfig(orientation="up")
    with pytest.raises(ConfigurationError, match="standoff_m"):
        WaypointConfig(standoff_m=1.0)
