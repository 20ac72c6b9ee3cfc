import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.metrics import depth_rms_um, nearest_distance_m, surface_distance


def plane(x, y):
    return 1e-3 + x + 0.0 * y  # 45 degrees


def points_above(offset_m):
    x, y = np.meshgrid(np.linspace(0, 1e-3, 7), np.linspace(0, 1e-3, 5))
    return np.stack([x.ravel(), y.ravel(), plane(x, y).ravel() + offset_m], axis=1)


def test_depth_rms_on_a_known_offset():
    assert depth_rms_um(points_above(20e-6), plane) == pytest.approx(20.0)


def test_distance_is_perpendicular_and_signed():
    result = surface_distance(points_above(-20e-6), plane)
    assert result.offset_um == pytest.approx(-20 / np.sqrt(2))
    assert result.spread_um == pytest.approx(0.0, abs=1e-6)
    assert result.max_um == pytest.approx(20 / np.sqrt(2))
    assert result.rms_um == pytest.approx(20 / np.sqrt(2))


def test_spread_is_taken_about_the_median():
    points = np.zeros((4, 3))
    points[:, 2] = np.array([1, 1, 1, 5]) * 1e-6
    result = surface_distance(points, lambda x, y: 0 * x)
    assert (result.offset_um, result.max_um) == (pytest.approx(1.0), pytest.approx(5.0))
    assert result.spread_um == pytest.approx(2.0)
    assert result.rms_um == pytest.approx(np.sqrt(7.0))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((4, 2)), np.full((4, 3), np.nan)])
def test_points_that_cannot_be_judged(points):
    with pytest.raises(QueryError, match="expected"):
        depth_rms_um(points, plane)


def test_nearest_distance_to_a_plane_is_perpendicular_and_signed():
    np.testing.assert_allclose(nearest_distance_m(points_above(-20e-6), plane), -20e-6 / np.sqrt(2), atol=1e-11)
    np.testing.assert_allclose(nearest_distance_m(points_above(3e-7), plane), 3e-7 / np.sqrt(2), atol=1e-11)


def test_nearest_distance_to_a_cylinder_by_hand():
    # z = 2 mm - sqrt((1 mm)^2 - x^2): a point d off the axis lies d - 1 mm outside the cylinder of 1 mm.
    radius = 1e-3

    def cylinder(x, y):
        return 2e-3 - np.sqrt(radius**2 - np.clip(x, -0.9e-3, 0.9e-3) ** 2) + 0.0 * y

    angle = np.radians([-30.0, 0.0, 17.0, 35.0])
    for distance in (-60e-6, 40e-6):  # deeper is towards the axis
        reach = radius - distance
        points = np.stack([reach * np.sin(angle), 0.2e-3 * angle, 2e-3 - reach * np.cos(angle)], axis=1)
        np.testing.assert_allclose(nearest_distance_m(points, cylinder), distance, atol=5e-9)


def test_nearest_distance_beside_a_step_is_to_its_wall_or_rim():
    # The tissue's surface is at 1 mm for x < 0 and 0.2 mm deeper beyond, with the wall at x = 0 between.
    def step(x, y):
        return 1e-3 + 0.2e-3 * (x >= 0.0) + 0.0 * y

    points = np.array(
        [
            [30e-6, 0.0, 1.1e-3],  # 100 um above the floor, 30 um from the wall
            [30e-6, 0.0, 0.96e-3],  # 40 um above the rim and 30 um beside it: 50 um
            [-30e-6, 0.0, 1.1e-3],  # buried, 100 um below the upper floor, 30 um from the wall
            [150e-6, 0.0, 1.19e-3],  # 10 um above the floor
        ]
    )
    distance = nearest_distance_m(points, step)
    np.testing.assert_allclose(distance, [-30e-6, -50e-6, 30e-6, -10e-6], atol=2.5e-6)
    # The axial figure alone would say 100, 240, 100 and 10 um.
    assert np.all(np.abs(distance) <= np.array([100.1, 240.1, 100.1, 10.1]) * 1e-6)


def test_nearest_distance_never_exceeds_the_axial_one():
    generator = np.random.default_rng(2)

    def waves(x, y):
        return 1e-3 + 100e-6 * np.sin(x / 60e-6) + 0.3 * y

    points = generator.random((200, 3)) * [2e-3, 1e-3, 0.0]
    points[:, 2] = waves(points[:, 0], points[:, 1]) + generator.normal(scale=80e-6, size=200)
    distance = nearest_distance_m(points, waves)
    axial = points[:, 2] - waves(points[:, 0], points[:, 1])
    assert np.all(np.abs(distance) <= np.abs(axial) + 1e-12)
    assert np.all(np.sign(distance) == np.sign(axial))
    assert np.abs(distance).mean() < 0.7 * np.abs(axial).mean()


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_nearest_distance_of_no_points(points):
    with pytest.raises(QueryError, match="expected"):
        nearest_distance_m(points, plane)
