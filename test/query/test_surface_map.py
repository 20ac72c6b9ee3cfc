import numpy as np
import pytest

from octn_ros.errors import ConfigurationError, QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import SurfaceMapConfig, surface_intensity, surface_map
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import Volume, VolumeGeometry, gaussian_filter

SPACING_M = (28e-6, 14.59e-6, 14e-6)
AIR, TISSUE = 0.1, 0.7
SHAPE = (24, 64, 32)


def depth_voxels(bscan, lateral):
    return 20.0 + 0.4 * bscan + 0.2 * lateral


def edge(noise=0.0, spikes=0):
    """Voxels [bscan, axial, lateral] with a blurred edge on a tilted plane, noise, and grains steeper than it."""
    bscan, axial, lateral = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    below = axial - depth_voxels(bscan, lateral)
    voxels = AIR + (TISSUE - AIR) / (1 + np.exp(-below / 0.8))
    rng = np.random.default_rng(3)
    voxels += noise * rng.standard_normal(SHAPE)
    for _ in range(spikes):
        place = rng.integers(SHAPE[0]), rng.integers(SHAPE[2])
        voxels[place[0], 45:48, place[1]], voxels[place[0], 48:51, place[1]] = 0.0, 1.0
    return voxels.astype(np.float32)


def field_of(voxels):
    geometry = VolumeGeometry(SHAPE, SPACING_M, origin_m=(1e-3, 2e-3, -5e-4))
    return InterpolatedField(Volume(voxels, geometry, (0.0, 1.0)))


def error_voxels(surface):
    lateral = (surface.lateral_m - 1e-3) / SPACING_M[2]
    bscan = (surface.bscan_m - 2e-3) / SPACING_M[0]
    depth = (surface.depth_m + 5e-4) / SPACING_M[1]
    return depth - depth_voxels(bscan[:, None], lateral[None, :])


def test_known_plane_is_found_within_a_tenth_of_a_voxel_and_tau_is_its_middle():
    surface = surface_map(field_of(edge()))
    assert surface.depth_m.shape == (SHAPE[0], SHAPE[2])
    assert np.abs(error_voxels(surface)).max() < 0.1
    assert surface_intensity(surface) == pytest.approx((AIR + TISSUE) / 2, abs=0.02)
    assert surface.confidence.min() > 0.9


def test_speckle_and_grains_in_the_depth_do_not_mislead():
    field = field_of(edge(noise=0.05, spikes=60))
    surface = surface_map(field)
    assert np.abs(error_voxels(surface)).max() < 2.0
    # The plain argmax is misled: that is why the neighbours are asked, and why the method is named.
    plain = surface_map(field, SurfaceMapConfig(consensus_ascans=1))
    assert np.abs(error_voxels(plain)).max() > 10
    assert "median of 5^2" in SurfaceMapConfig().method
    assert SurfaceMapConfig(axial_sigma_voxels=0.0, consensus_ascans=1).method == "largest axial rise"
    # A grain steeper than the surface takes all confidence from its A-scan.
    assert surface.confidence.min() == 0.0
    assert np.median(surface.confidence) > 0.5


def test_a_fall_of_intensity_is_no_surface():
    voxels = edge()
    voxels[:, 55:, :] = 0.0  # falls by 0.7, more steeply than the surface rises
    assert np.abs(error_voxels(surface_map(field_of(voxels)))).max() < 0.1


@pytest.mark.parametrize("most", [4, 5, 17, 100, 766])
def test_lattice_stays_below_the_limit_and_spans_the_field(most):
    surface = surface_map(field_of(edge()), SurfaceMapConfig(max_ascans=most))
    rows, columns = surface.depth_m.shape
    assert 4 <= rows * columns <= most
    np.testing.assert_allclose(surface.lateral_m[[0, -1]], [1e-3, 1e-3 + 31 * SPACING_M[2]])
    np.testing.assert_allclose(surface.bscan_m[[0, -1]], [2e-3, 2e-3 + 23 * SPACING_M[0]])
    assert np.abs(error_voxels(surface)).max() < 0.2


def test_a_region_is_searched_alone_and_clipped_to_the_field():
    surface = surface_map(field_of(edge()), lateral_range_m=(1.1e-3, 9.0), bscan_range_m=(2.1e-3, 2.3e-3))
    np.testing.assert_allclose(surface.lateral_m[[0, -1]], [1.1e-3, 1e-3 + 31 * SPACING_M[2]])
    np.testing.assert_allclose(surface.bscan_m[[0, -1]], [2.1e-3, 2.3e-3])
    assert np.abs(error_voxels(surface)).max() < 0.2


def test_sampling_interpolates_and_holds_the_edge():
    surface = surface_map(field_of(edge()))
    points = np.array([[1e-3 + 10.5 * SPACING_M[2], 2e-3 + 3.25 * SPACING_M[0]], [-1.0, -1.0]])
    depth = (surface.sample(surface.depth_m, points) + 5e-4) / SPACING_M[1]
    np.testing.assert_allclose(depth, [depth_voxels(3.25, 10.5), depth_voxels(0, 0)], atol=0.1)


@pytest.mark.parametrize("region", [(0.0, 0.5e-3), (1.2e-3, 1.2e-3), (1.3e-3, 1.2e-3), (float("nan"), 1.2e-3)])
def test_regions_that_are_none(region):
    with pytest.raises(QueryError, match=r"expected lateral_range_m with first < last .*1\.000 to 1\.434 mm"):
        surface_map(field_of(edge()), lateral_range_m=region)


def test_a_field_that_never_rises_has_no_surface():
    falling = np.broadcast_to(np.linspace(1.0, 0.0, SHAPE[1], dtype=np.float32)[None, :, None], SHAPE).copy()
    with pytest.raises(QueryError, match="upside down"):
        surface_map(field_of(falling))


def test_settings_are_checked():
    with pytest.raises(ConfigurationError, match="max_ascans: expected at least 4"):
        SurfaceMapConfig(max_ascans=1)
    with pytest.raises(ConfigurationError, match="axial_sigma_voxels: expected a finite number"):
        SurfaceMapConfig(axial_sigma_voxels=float("nan"))


def phantom_error_um(phantom, volume, **settings):
    surface = surface_map(InterpolatedField(volume), SurfaceMapConfig(**settings))
    truth_m = phantom.surface_depth_m(surface.lateral_m, surface.bscan_m[:, None])
    return (surface.depth_m - truth_m) * 1e6, surface.confidence


@pytest.mark.parametrize("name", ["flat+0.25", "tilted30", "steep45", "wavy", "stepped", "motion"])
def test_the_surface_of_a_phantom_lies_where_it_is(name):
    phantom = make_phantom(named_phantom(name, shape=(32, 192, 40), speckle="averaged"))
    error, confidence = phantom_error_um(phantom, phantom.volume)
    # The steepest place of a log-compressed edge lies above the interface, by as much everywhere.
    assert -14.0 < np.median(error) < 0.0
    assert np.sqrt(np.mean((error - np.median(error)) ** 2)) < 0.3 * 14.59
    assert np.median(confidence) > 0.6


def test_neighbours_outvote_speckle_on_raw_voxels_and_confidence_says_how_it_is():
    phantom = make_phantom(named_phantom("tilted30", shape=(48, 192, 48), speckle="single-look", snr_db=13.0))

    def lost(**settings):
        error, confidence = phantom_error_um(phantom, phantom.volume, **settings)
        return np.mean(np.abs(error) > 75.0), np.median(confidence)

    share, confidence = lost()
    assert share < 0.03
    assert lost(consensus_sigma_ascans=0.0)[0] > 3 * share
    assert lost(consensus_ascans=1)[0] > 0.4
    assert confidence < 0.1
    smooth, sure = phantom_error_um(phantom, gaussian_filter(phantom.volume, 1.0))
    assert np.abs(smooth - np.median(smooth)).max() < 30.0
    assert np.median(sure) > 0.5
