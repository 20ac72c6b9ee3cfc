import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import (
    BandQuery,
    NearSurface,
    Sphere,
    SurfaceMap,
    find_band,
    iso_surface,
    surface_intensity,
    surface_map,
)
from octn_ros.simulation import PhantomConfig, make_phantom


@pytest.fixture(scope="module")
def phantom():
    return make_phantom(PhantomConfig(shape=(24, 96, 40), surface="tilted", tilt_deg=8.0, speckle="single-look"))


def tilted_map():
    x, y = np.linspace(0.0, 1e-3, 5), np.linspace(0.0, 2e-3, 4)
    depth = 1e-3 + 0.1 * x[None, :] + 0.2 * y[:, None]
    return SurfaceMap(depth, np.zeros((4, 5), np.float32), np.zeros((4, 5), np.float32), x, y)


def test_the_layer_follows_the_map_and_ends_with_it():
    region = NearSurface(tilted_map(), above_m=1e-4, below_m=2e-4)
    depth = 1e-3 + 0.1 * 0.33e-3 + 0.2 * 1.1e-3
    points = np.array([
        [0.33e-3, 1.1e-3, depth - 0.9e-4], [0.33e-3, 1.1e-3, depth + 1.9e-4],
        [0.33e-3, 1.1e-3, depth - 1.1e-4], [0.33e-3, 1.1e-3, depth + 2.1e-4],
        [1.1e-3, 1.1e-3, 1.33e-3], [0.5e-3, -1e-4, 1.05e-3],
    ])  # fmt: skip
    assert region.contains(*points.T).tolist() == [True, True, False, False, False, False]
    np.testing.assert_allclose(region.bounds_m(), [[0, 0, 0.9e-3], [1e-3, 2e-3, 1.7e-3]], atol=2e-9)
    for above, below in ((0.0, 0.0), (-2e-4, 1e-4), (np.inf, 0.0)):
        with pytest.raises(QueryError, match="above \\+ below > 0"):
            NearSurface(tilted_map(), above, below)


def test_a_mesh_near_the_surface_leaves_speckle_in_the_depth_out(phantom):
    field = InterpolatedField(phantom.volume)
    surface = surface_map(field)
    tau = surface_intensity(surface)
    near = iso_surface(field, tau, NearSurface(surface, 60e-6, 60e-6))
    everywhere = iso_surface(field, tau)
    assert len(near.faces) < 0.3 * len(everywhere.faces)

    def far(mesh):
        x, y, z = mesh.vertices_m.T
        return np.abs(z - phantom.surface_depth_m(x, y)).max()

    assert far(near) < 120e-6 < 400e-6 < far(everywhere)
    assert near.faces.max() == len(near.vertices_m) - 1


def test_a_band_below_the_surface(phantom):
    field = InterpolatedField(phantom.truth)
    surface = surface_map(field)
    found = find_band(field, BandQuery(0.0, 1.0), NearSurface(surface, -50e-6, 100e-6))
    x, y, z = found.points_m.T
    below = z - phantom.surface_depth_m(x, y)
    assert 0.95 * 24 * 40 * 50 / 14.59 < len(below) < 1.05 * 24 * 40 * 50 / 14.59
    assert below.min() > 30e-6
    assert below.max() < 120e-6


def test_a_mesh_is_cut_by_the_region_and_not_by_its_box(phantom):
    field = InterpolatedField(phantom.truth)
    surface = surface_map(field)
    centre = float(surface.lateral_m.mean()), float(surface.bscan_m.mean()), float(np.median(surface.depth_m))
    mesh = iso_surface(field, surface_intensity(surface), Sphere(centre, 120e-6))
    distance = np.linalg.norm(mesh.vertices_m - centre, axis=1)
    assert distance.max() <= 120e-6 + 14e-6
    assert mesh.area_m2 == pytest.approx(np.pi * 120e-6**2, rel=0.35)
    elsewhere = Sphere(centre, 120e-6) & ~NearSurface(surface, 50e-6, 50e-6)
    with pytest.raises(QueryError, match="without a triangle"):
        iso_surface(field, surface_intensity(surface), elsewhere)
