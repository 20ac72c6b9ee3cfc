import math

import numpy as np
import pytest

from octn_ros.simulation.surface import TissueSurface

CENTRE = (1.8e-3, 1.7e-3)
SURFACES = {
    "flat": TissueSurface.flat(0.5e-3, CENTRE),
    "tilted": TissueSurface.tilted(0.5e-3, CENTRE, 20.0),
    "wavy": TissueSurface.wavy(0.5e-3, CENTRE, 3.0, 80e-6, 2e-3),
}


@pytest.fixture
def lateral_points():
    generator = np.random.default_rng(1)
    return generator.uniform(0.0, 3.5e-3, 200), generator.uniform(0.0, 3.5e-3, 200)


def test_flat_surface_has_one_depth_and_the_beam_as_its_normal(lateral_points):
    surface = SURFACES["flat"]
    np.testing.assert_array_equal(surface.depth_at(*lateral_points), 0.5e-3)
    np.testing.assert_array_equal(surface.normal_at(*lateral_points), np.tile([0.0, 0.0, 1.0], (200, 1)))


@pytest.mark.parametrize("tilt_deg", [1.0, 20.0, 45.0])
def test_tilted_surface_leans_by_its_angle(lateral_points, tilt_deg):
    normal = TissueSurface.tilted(0.5e-3, CENTRE, tilt_deg).normal_at(*lateral_points)
    np.testing.assert_allclose(normal[:, 2], math.cos(math.radians(tilt_deg)), rtol=1e-12)


def test_wavy_surface_stays_within_its_amplitude_of_the_plane(lateral_points):
    plane = TissueSurface.tilted(0.5e-3, CENTRE, 3.0)
    waves = SURFACES["wavy"].depth_at(*lateral_points) - plane.depth_at(*lateral_points)
    assert np.abs(waves).max() <= 80e-6
    assert np.ptp(waves) > 80e-6


@pytest.mark.parametrize("name", SURFACES)
def test_normals_are_unit_point_into_the_tissue_and_stand_on_the_surface(lateral_points, name):
    x, y = lateral_points
    surface, step = SURFACES[name], 1e-7
    normal = surface.normal_at(x, y)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=1e-12)
    assert (normal[:, 2] > 0).all()
    for dx, dy in ((step, 0.0), (0.0, step)):
        rise = surface.depth_at(x + dx, y + dy) - surface.depth_at(x - dx, y - dy)
        tangent = np.stack([np.full(200, 2 * dx), np.full(200, 2 * dy), rise], axis=-1) / step
        np.testing.assert_allclose(np.sum(normal * tangent, axis=-1), 0.0, atol=1e-6)


def test_coordinates_broadcast():
    surface = SURFACES["wavy"]
    x, y = np.linspace(0, 3e-3, 5), np.linspace(0, 3e-3, 4)
    assert surface.depth_at(x[None, :], y[:, None]).shape == (4, 5)
    assert surface.normal_at(x[None, :], y[:, None]).shape == (4, 5, 3)
    assert surface.normal_at(0.0, 0.0).shape == (3,)
