import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import SurfaceMap, enface, layer_mean, surface_map
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import Volume, VolumeGeometry

VOXELS = np.random.default_rng(1).integers(0, 256, (5, 7, 6), dtype=np.uint8)


@pytest.fixture
def volume():
    return Volume.from_array(VOXELS, (1e-5, 1e-5, 1e-5))


@pytest.mark.parametrize(("mode", "along_beam"), [("mip", np.max), ("mean", np.mean)])
def test_enface_of_volume_and_field(volume, mode, along_beam):
    expected = along_beam(VOXELS / 255.0, axis=1)
    view = enface(volume, mode)
    assert view.dtype == np.float32
    np.testing.assert_allclose(view, expected, atol=1e-6)
    shares = []
    np.testing.assert_allclose(enface(InterpolatedField(volume), mode, progress=shares.append), expected, atol=1e-5)
    assert shares[-1] == 1.0


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_enface_of_a_volume_is_that_of_its_normalised_voxels_to_the_last_bit(dtype):
    volume = Volume.from_array(VOXELS.astype(dtype), (1e-5, 1e-5, 1e-5), intensity_range=(40.0, 211.0))
    shares = []
    np.testing.assert_array_equal(enface(volume, progress=shares.append), volume.normalized().max(axis=1))
    assert shares == [1.0]


def test_unknown_view(volume):
    with pytest.raises(QueryError, match="mip or mean, got 'median'"):
        enface(volume, "median")


def test_a_layer_is_averaged_below_a_surface_that_is_not_flat():
    # Intensity falls linearly with the depth below a tilted plane: the mean of a layer is its middle's, everywhere.
    geometry = VolumeGeometry((8, 60, 10), (28e-6, 14.59e-6, 14e-6), (1e-3, 2e-3, 3e-3))
    bscan, axial, lateral = np.meshgrid(*map(np.arange, geometry.shape), indexing="ij")
    depth = 10 + 0.5 * bscan + 1.5 * lateral
    below_m = (axial - depth) * geometry.spacing_m[1]
    field = InterpolatedField(Volume((0.6 - 400.0 * below_m).astype(np.float32), geometry, (0.0, 1.0)))
    axes = geometry.voxel_to_metric(np.stack([bscan[:, 0], depth[:, 0], lateral[:, 0]], axis=-1))
    nothing = np.zeros((8, 10), np.float32)
    surface = SurfaceMap(axes[..., 2], nothing, nothing, axes[0, :, 0], axes[:, 0, 1])
    for from_m, to_m in ((0.0, 2e-4), (1e-4, 1.5e-4), (-5e-5, 5e-5)):
        view = layer_mean(field, surface, from_m, to_m)
        np.testing.assert_allclose(view, 0.6 - 400.0 * (from_m + to_m) / 2, atol=1e-5)
    leaving = layer_mean(field, surface, 4e-4, 5e-4)
    bottom = geometry.origin_m[2] + geometry.extent_m[2]
    np.testing.assert_array_equal(np.isnan(leaving), axes[..., 2] + 5e-4 > bottom)
    assert 0 < np.isnan(leaving).mean() < 1
    with pytest.raises(QueryError, match="from < to"):
        layer_mean(field, surface, 1e-4, 1e-4)
    with pytest.raises(QueryError, match=r"at most 0\.861 mm apart, got 0 to 1 mm"):
        layer_mean(field, surface, 0.0, 1e-3)


def test_a_layer_of_the_phantom_shows_the_inclusion_where_it_is():
    phantom = make_phantom(PhantomConfig(shape=(32, 96, 48), surface="tilted"))
    field = InterpolatedField(phantom.truth)
    surface = surface_map(field)
    # A tenth to a third of the depth below the surface: the inclusion's middle lies at three tenths.
    deep = field.geometry.extent_m[2] * 0.75
    view = layer_mean(field, surface, 0.25 * deep, 0.35 * deep)
    row, column = np.unravel_index(np.nanargmax(view), view.shape)
    assert (column / 47, row / 31) == pytest.approx((0.70, 0.36), abs=0.08)
