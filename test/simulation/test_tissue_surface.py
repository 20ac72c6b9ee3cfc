import math

import numpy as np
import pytest

from octn_ros.simulation.surface import TissueSurface

CENTRE = (1.8e-3, 1.7e-3)
SURFACES = {
    "flat": TissueSurface.flat(0.5e-3, CENTRE),
    "tilted": TissueSurface.tilted(0.5e-3, CENTRE, 20.0),
    "wavy": TissueSurface.wavy(0.5e-3, CENTRE, 3.0, 80e-6, 2e-3),
    "rough": TissueSurface.rough(0.5e-3, CENTRE, 3.0, 10e-6, 150e-6, seed=0),
    "stepped": TissueSurface.stepped(0.5e-3, CENTRE, 2.0, 150e-6, 20e-6),
    "steep": TissueSurface.steep(0.5e-3, CENTRE, 40.0, 2e-3),
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


@pytest.mark.parametrize("seed", range(3))
def test_roughness_has_its_rms_and_its_correlation_length(seed):
    surface = TissueSurface.rough(0.0, CENTRE, 0.0, 10e-6, 150e-6, seed)
    # Over an area of many correlation lengths, as the statement is about the whole plane.
    x, y = np.random.default_rng(seed).uniform(-0.1, 0.1, (2, 20000))
    here = surface.depth_at(x, y)
    assert np.sqrt(np.mean(here**2)) == pytest.approx(10e-6, rel=0.02)
    for direction in (0.0, 1.0, 2.0):
        for lag in (0.5, 1.0, 1.5):
            there = surface.depth_at(x + lag * 150e-6 * np.cos(direction), y + lag * 150e-6 * np.sin(direction))
            # 64 waves in random directions are not quite isotropic, and the band ends.
            assert np.mean(here * there) / np.mean(here**2) == pytest.approx(np.exp(-(lag**2)), abs=0.25)
    # Band-limited: no wave is shorter than 2 pi / (2.45 sqrt(2) / correlation).
    shortest = min(2 * math.pi / math.hypot(*wave.wave_vector) for wave in surface.waves)
    assert shortest >= 2 * math.pi / (2.46 * math.sqrt(2.0)) * 150e-6


def test_other_seeds_are_other_roughness():
    one, same, other = (TissueSurface.rough(0.0, CENTRE, 0.0, 10e-6, 150e-6, seed) for seed in (0, 0, 1))
    assert one == same
    assert abs(one.depth_at(1e-3, 1e-3) - other.depth_at(1e-3, 1e-3)) > 1e-7


def test_steps_have_their_heights_and_rise():
    surface = TissueSurface.stepped(0.5e-3, CENTRE, 0.0, 150e-6, 20e-6)
    step = surface.steps[0]
    direction = np.array(step.direction)
    along = np.array([-direction[1], direction[0]]) * -1.5e-3  # away from the other step
    place = np.array(CENTRE) + step.place_m * direction + along
    across = np.linspace(-150e-6, 150e-6, 3001)
    depth = surface.depth_at(*(place[:, None] + across * direction[:, None]))
    low, high = depth[0], depth[-1]
    assert high - low == pytest.approx(150e-6, abs=1e-7)
    rise = np.interp([low + 0.1 * (high - low), low + 0.9 * (high - low)], depth, across)
    assert np.diff(rise)[0] == pytest.approx(20e-6, rel=1e-3)


@pytest.mark.parametrize("steepest_deg", [10.0, 30.0, 45.0])
def test_steep_folds_reach_their_slope_and_no_more(steepest_deg):
    surface = TissueSurface.steep(0.5e-3, CENTRE, steepest_deg, 2e-3)
    x, y = np.meshgrid(np.linspace(0, 4e-3, 400), np.linspace(0, 4e-3, 400))
    lean = np.degrees(np.arccos(np.clip(surface.normal_at(x, y)[..., 2], -1.0, 1.0)))
    assert steepest_deg - 0.05 < lean.max() <= steepest_deg + 1e-9


@pytest.mark.parametrize("name", SURFACES)
def test_normals_are_unit_point_into_the_tissue_and_stand_on_the_surface(lateral_points, name):
    x, y = lateral_points
    surface, step = SURFACES[name], 1e-8
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
