"""Nearest points and distances, against brute force and against planes."""

import math

import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.simulation import TissueSurface
from octn_ros.simulation.crater import AblatedSurface
from octn_ros.simulation.motion import Motion, ScannedSurface

CENTRE = (1.8e-3, 1.7e-3)
WAVY = TissueSurface.wavy(0.5e-3, CENTRE, 3.0, 80e-6, 2e-3)
MOTION = Motion.drawn(128, 28e-6, 5e-6, 7e-6, 60e-6, seed=1)
Y, X = np.meshgrid(np.arange(128) * 28e-6, np.arange(256) * 14e-6, indexing="ij")
CRATER_M = 120e-6 * np.exp(-((X - 1.5e-3) ** 2 + (Y - 1.9e-3) ** 2) / (2 * 150e-6**2))
INTERFACES = {
    "flat": TissueSurface.flat(0.5e-3, CENTRE),
    "tilted": TissueSurface.tilted(1.5e-3, CENTRE, 30.0),
    "wavy": WAVY,
    "rough": TissueSurface.rough(0.5e-3, CENTRE, 2.0, 10e-6, 150e-6, seed=3),
    "stepped": TissueSurface.stepped(0.5e-3, CENTRE, 2.0, 150e-6, 20e-6),
    "steep": TissueSurface.steep(0.8e-3, CENTRE, 45.0, 2e-3),
    "moved": WAVY.moved(40.0, (0.1e-3, -0.2e-3, 0.05e-3)),
    "scanned": ScannedSurface(WAVY, MOTION),
    "ablated": AblatedSurface(WAVY, CRATER_M, (28e-6, 14e-6)),
}
SMOOTH = [name for name in INTERFACES if name not in ("scanned", "ablated")]


@pytest.fixture
def places():
    generator = np.random.default_rng(5)
    return generator.uniform(0.3e-3, 3.2e-3, 300), generator.uniform(0.3e-3, 3.2e-3, 300)


def lifted(interface, places, generator, most_m):
    height = generator.uniform(-most_m, most_m, len(places[0]))
    return interface.point_at(*places) + height[:, None] * interface.normal_at(*places), height


@pytest.mark.parametrize("name", INTERFACES)
def test_no_point_of_the_interface_is_nearer_than_the_nearest(name, places):
    interface = INTERFACES[name]
    points, _ = lifted(interface, places, np.random.default_rng(0), 73e-6)
    distance = interface.distance(points)
    for point, found in zip(points[::15], distance[::15], strict=True):
        step = np.linspace(-90e-6, 90e-6, 151)
        x, y = np.meshgrid(point[0] + step, point[1] + step)
        least = np.linalg.norm(interface.point_at(x, y) - point, axis=-1).min()
        assert abs(found) <= least + 0.5e-6
        assert least <= abs(found) + 1.5e-6


@pytest.mark.parametrize("name", SMOOTH)
def test_nearest_points_lie_on_the_interface_and_straight_below(name, places):
    interface = INTERFACES[name]
    points, _ = lifted(interface, places, np.random.default_rng(1), 60e-6)
    near = interface.nearest_point(points)
    np.testing.assert_allclose(near[:, 2], interface.depth_at(near[:, 0], near[:, 1]), rtol=0, atol=1e-15)
    normal = interface.normal_at(near[:, 0], near[:, 1])
    off = points - near - np.sum((points - near) * normal, axis=-1, keepdims=True) * normal
    assert np.linalg.norm(off, axis=-1).max() < 1e-9


@pytest.mark.parametrize("name", ["flat", "tilted", "wavy", "moved"])
def test_distance_is_signed_and_is_the_height_along_the_normal(name, places):
    # No radius of curvature of these is below 0.4 mm, so the point that was lifted is the nearest one.
    points, height = lifted(INTERFACES[name], places, np.random.default_rng(2), 100e-6)
    np.testing.assert_allclose(INTERFACES[name].distance(points), height, rtol=0, atol=1e-9)


def test_distance_of_many_axes_and_of_points_on_the_interface(places):
    points = WAVY.point_at(*places).reshape(3, 100, 3)
    distance = WAVY.distance(points)
    assert distance.shape == (3, 100)
    np.testing.assert_allclose(distance, 0.0, atol=1e-12)
    assert WAVY.distance([1e-3, 1e-3, 1.0]) > 0.9


@pytest.mark.parametrize("name", INTERFACES)
def test_slopes_are_the_derivatives_of_depth(name, places):
    interface, (x, y), h = INTERFACES[name], places, 1e-8
    # Displacements and craters have edges at A-scans; away from them slope and difference agree.
    if name in ("scanned", "ablated"):
        x, y = np.floor(x / 14e-6) * 14e-6 + 7e-6, np.floor(y / 28e-6) * 28e-6 + 14e-6
    slope_x, slope_y = interface.slope_at(x, y)
    by_x = (interface.depth_at(x + h, y) - interface.depth_at(x - h, y)) / (2 * h)
    by_y = (interface.depth_at(x, y + h) - interface.depth_at(x, y - h)) / (2 * h)
    np.testing.assert_allclose(slope_x, by_x, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(slope_y, by_y, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", [*SMOOTH, "scanned"])
def test_curvatures_are_the_derivatives_of_slope(name, places):
    interface, (x, y), h = INTERFACES[name], places, 1e-8
    if name == "scanned":
        y = np.floor(y / 28e-6) * 28e-6 + 14e-6
    xx, xy, yy = interface.curvature_at(x, y)
    ahead, behind = interface.slope_at(x + h, y), interface.slope_at(x - h, y)
    left, right = interface.slope_at(x, y + h), interface.slope_at(x, y - h)
    scale = max(1.0, float(np.abs([xx, xy, yy]).max()))
    np.testing.assert_allclose(xx, (ahead[0] - behind[0]) / (2 * h), rtol=0, atol=1e-4 * scale)
    np.testing.assert_allclose(xy, (ahead[1] - behind[1]) / (2 * h), rtol=0, atol=1e-4 * scale)
    np.testing.assert_allclose(yy, (left[1] - right[1]) / (2 * h), rtol=0, atol=1e-4 * scale)


def test_moved_turns_about_the_centre_and_then_shifts(places):
    x, y = places
    angle, shift = math.radians(40.0), (0.1e-3, -0.2e-3, 0.05e-3)
    turned_x = CENTRE[0] + math.cos(angle) * (x - CENTRE[0]) - math.sin(angle) * (y - CENTRE[1]) + shift[0]
    turned_y = CENTRE[1] + math.sin(angle) * (x - CENTRE[0]) + math.cos(angle) * (y - CENTRE[1]) + shift[1]
    for name in ("flat", "tilted", "wavy", "rough", "stepped", "steep"):
        surface = INTERFACES[name]
        moved = surface.moved(40.0, shift)
        np.testing.assert_allclose(
            moved.depth_at(turned_x, turned_y), surface.depth_at(x, y) + shift[2], rtol=0, atol=1e-12
        )
        assert surface.moved(0.0, (0.0, 0.0, 0.0)) is surface


@pytest.mark.parametrize("points", [np.zeros((4, 2)), np.array(3.0), np.array([[0.0, np.nan, 0.0]])])
def test_points_that_are_none_are_refused(points):
    with pytest.raises(QueryError, match="nearest_point: expected"):
        WAVY.nearest_point(points)
