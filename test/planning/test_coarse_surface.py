import numpy as np
import pytest
import torch

from octn_ros.field import InterpolatedField
from octn_ros.planning import CoarseSurfaceConfig, RasterConfig, SurfaceSearchConfig, find_surface, rectangle_raster
from octn_ros.planning.candidate_choice import choose_smooth
from octn_ros.planning.coarse_surface import CoarseSurface, coarse_surface
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import gaussian_filter

RASTER = rectangle_raster((2e-4, -1e-4), (8e-4, 7e-4), 0.0)


def error_m(field, config=None):
    surface = coarse_surface(field, RASTER.points_m, config or CoarseSurfaceConfig())
    depth = 5e-4 + surface.depth_at(RASTER.points_m) * 14.59e-6
    return depth - field.depth(*RASTER.points_m.T), surface


def test_a_slope_is_found_within_half_a_voxel(plane_field):
    error, surface = error_m(plane_field)
    assert np.abs(error).max() < 7.3e-6
    assert surface.typical_step == pytest.approx(0.6, abs=0.03)
    assert surface.clearness.min() > 0.95
    np.testing.assert_allclose(surface.slope_at(RASTER.points_m).mean(axis=0) * 14.59e-6, [0.3, -0.15], atol=0.01)


@pytest.mark.parametrize("thickness_um", [15, 45])
def test_a_thin_layer_in_the_air_is_no_surface(make_field, thickness_um):
    def layer(points):  # brighter than the tissue, 200 um above it
        z = field.geometry.canonical_to_metric(points.double())[..., 2]
        return 0.9 * (torch.sigmoid((z - 8e-4) / 4e-6) - torch.sigmoid((z - 8e-4 - thickness_um * 1e-6) / 4e-6))

    field = make_field(lambda x, y: 1e-3 + 0 * x)
    field.noise = layer
    error, _ = error_m(field)
    assert np.abs(error).max() < 30e-6


def test_a_brighter_step_below_the_surface_is_no_surface(make_field):
    def band(points):
        z = field.geometry.canonical_to_metric(points.double())[..., 2]
        return 0.9 * torch.sigmoid((z - 1.3e-3) / 8e-6)

    field = make_field(lambda x, y: 1e-3 + 0.1 * x)
    field.noise = band
    error, surface = error_m(field)
    assert np.abs(error).max() < 7.3e-6
    assert surface.clearness.min() > 0.9  # what lies deeper does not make a surface doubtful


def test_a_cliff_stays_where_it_is(make_field):
    field = make_field(lambda x, y: 1e-3 + 2.5e-4 * (x > 5e-4))
    error, _ = error_m(field)
    away = np.abs(RASTER.points_m[:, 0] - 5e-4) > 60e-6
    assert np.abs(error[away]).max() < 20e-6


def test_neighbours_outvote_the_strongest_candidate_but_a_cliff_remains():
    depth = np.full((9, 9, 2), 20)
    depth[..., 1] = 60
    depth[:, 5:, 0] = 40
    strength = np.stack([np.full((9, 9), 0.8), np.zeros((9, 9))], axis=-1).astype(np.float32)
    strength[4, 2] = 0.8, 1.2
    chosen = choose_smooth(depth, strength, (0.15, 0.15), 0.4)
    assert (chosen == 0).all()
    alone = choose_smooth(depth, strength, (0.15, 0.15), 0.0)
    assert alone[4, 2] == 1


@pytest.mark.parametrize("name", ["glare", "detached-layer", "stepped", "shadow", "dye", "steep30"])
def test_waypoints_on_adverse_tissue_are_right_or_given_up(name):
    phantom = make_phantom(named_phantom(f"{name}-13dB-single-look", shape=(64, 160, 128)))
    field = InterpolatedField(gaussian_filter(phantom.volume))
    centre = np.array(field.geometry.extent_m[:2]) / 2
    raster = rectangle_raster(centre - 0.75e-3, centre + 0.75e-3, 0.0, RasterConfig(point_spacing_along="lateral"))
    artefact = phantom.artefact_mask(*raster.points_m.T)
    for refinement in ("newton", "least_squares"):
        search = find_surface(field, raster, None, SurfaceSearchConfig(refinement=refinement))
        kept = ~search.given_up
        distance = phantom.surface.distance(np.column_stack([raster.points_m, search.depth_m])[kept])
        assert np.abs(distance).max() < 73e-6
        assert kept[~artefact].mean() > 0.9
        clean = distance[~artefact[kept]]
        assert np.std(clean) < (7.3e-6 if name != "stepped" else 14.6e-6)


def surface_of(depth):
    """A coarse surface with these depths [9, 12] in voxels, 0.1 mm apart."""
    none = np.zeros(depth.shape, dtype=np.float32)
    lattice = np.arange(12) * 1e-4, np.arange(9) * 1e-4
    return CoarseSurface(depth, none, none, none, none, *lattice, typical_step=1.0, typical_air=0.0, axial_m=14.59e-6)


PLACES = np.random.default_rng(3).uniform((0.0, 0.0), (1.1e-3, 0.8e-3), (400, 2))


@pytest.mark.parametrize("slope", [1.0, -2.0])
def test_a_steep_slope_is_interpolated_however_coarse_the_lattice(slope):
    x, y = np.meshgrid(np.arange(12) * 1e-4, np.arange(9) * 1e-4)
    surface = surface_of(40.0 + slope * (x + 0.5 * y) / 14.59e-6)
    expected = 40.0 + slope * (PLACES[:, 0] + 0.5 * PLACES[:, 1]) / 14.59e-6
    np.testing.assert_allclose(surface.depth_at(PLACES), expected, atol=1e-6)


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_either_side_of_a_cliff_goes_on_to_the_middle_between_its_a_scans(slope):
    x = np.tile(np.arange(12) * 1e-4, (9, 1))
    surface = surface_of(20.0 + slope * x / 14.59e-6 + 20.0 * (x > 5.5e-4))
    expected = 20.0 + slope * PLACES[:, 0] / 14.59e-6 + 20.0 * (PLACES[:, 0] > 5.5e-4)
    off = np.abs(surface.depth_at(PLACES) - expected)
    # The foot and the edge of the cliff are interpolated as long as that is less than a cliff.
    assert off.max() * 14.59e-6 < 44e-6 + 1e-12
    assert (off < 1e-6).mean() > 0.9


@pytest.mark.parametrize("seed", [0, 1])
def test_slopes_of_45_degrees_are_kept(seed):
    phantom = make_phantom(named_phantom("steep45-13dB-single-look", seed=seed, tissue_seed=seed))
    field = InterpolatedField(gaussian_filter(phantom.volume))
    centre = np.array(field.geometry.extent_m[:2]) / 2
    raster = rectangle_raster(centre - 1.5e-3, centre + 1.5e-3, 0.0, RasterConfig(point_spacing_along="lateral"))
    search = find_surface(field, raster)
    kept = ~search.given_up
    assert kept.mean() > 0.987
    distance = phantom.surface.distance(np.column_stack([raster.points_m, search.depth_m])[kept])
    assert np.abs(distance).max() < 73e-6
