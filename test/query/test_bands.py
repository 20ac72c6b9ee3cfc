import numpy as np
import pytest
import torch

from octn_ros.errors import ConfigurationError, QueryError
from octn_ros.field import (
    FieldDescription,
    HashGridConfig,
    InterpolatedField,
    NetworkConfig,
    NeuralField,
    NeuralFieldConfig,
    NeuralModel,
)
from octn_ros.query import PAPER_BANDS, BandQuery, Box, Sphere, find_band, polygon
from octn_ros.query.bands import Lattice
from octn_ros.volume import Volume, VolumeGeometry

GEOMETRY = VolumeGeometry((6, 9, 8), (28e-6, 14.59e-6, 14e-6), (1e-3, -2e-3, 5e-4))
VOXELS = np.random.default_rng(5).random(GEOMETRY.shape, dtype=np.float32)


@pytest.fixture
def volume():
    return Volume(VOXELS, GEOMETRY, (0.0, 1.0), "log", stamp_ns=7)


def by_hand(chosen):
    """Points and intensities of the voxels of a mask, one by one."""
    index = np.argwhere(chosen)
    return GEOMETRY.voxel_to_metric(index), VOXELS[chosen]


@pytest.mark.parametrize("kind", ["volume", "field"])
def test_the_points_of_a_band_are_the_voxels_in_it(volume, kind):
    source = volume if kind == "volume" else InterpolatedField(volume)
    found = find_band(source, BandQuery(0.4, 0.6))
    points, intensity = by_hand((VOXELS >= 0.4) & (VOXELS <= 0.6))
    assert len(points) > 50
    np.testing.assert_allclose(found.points_m, points, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.intensity, intensity, atol=1e-5)
    assert found.searched == VOXELS.size
    assert found.description.stamp_ns == 7
    assert found.description.geometry == GEOMETRY
    assert found.description.intensity_scale == "log"
    assert found.description.kind == ("voxels" if kind == "volume" else "interpolated")


def test_a_region_leaves_the_rest_out_and_unsearched(volume):
    region = Sphere((1.05e-3, -1.93e-3, 5.6e-4), 4e-5) & ~Box((0, -1, 0), (1.05e-3, 1, 1))
    found = find_band(volume, BandQuery(0.0, 1.0), region)
    index = np.stack(np.meshgrid(*map(np.arange, GEOMETRY.shape), indexing="ij"), axis=-1)
    metres = GEOMETRY.voxel_to_metric(index)
    chosen = (np.linalg.norm(metres - [1.05e-3, -1.93e-3, 5.6e-4], axis=-1) <= 4e-5) & (metres[..., 0] > 1.05e-3)
    points, intensity = by_hand(chosen)
    assert len(points) > 5
    np.testing.assert_allclose(found.points_m, points, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.intensity, intensity)
    assert len(points) < found.searched < 0.4 * VOXELS.size


def test_a_polygon_is_a_column_through_all_depths(volume):
    x, y = GEOMETRY.origin_m[:2]
    corner = x + 3.5 * 14e-6, y + 2.5 * 28e-6
    found = find_band(volume, BandQuery(0.0, 1.0), polygon([(x - 1e-5, y - 1e-5), (corner[0], y - 1e-5), corner,
                                                            (x - 1e-5, corner[1])]))  # fmt: skip
    chosen = np.zeros(GEOMETRY.shape, dtype=bool)
    chosen[:3, :, :4] = True
    np.testing.assert_allclose(found.points_m, by_hand(chosen)[0], rtol=0, atol=1e-12)


def test_a_step_asks_the_field_between_its_voxels(volume):
    field = InterpolatedField(volume)
    found = find_band(field, BandQuery(0.45, 0.55, step_m=5e-6))
    lattice = Lattice.over(GEOMETRY, step_m=5e-6, name="test")
    assert found.searched == lattice.size > 10 * VOXELS.size
    from scipy.ndimage import map_coordinates

    index = GEOMETRY.metric_to_voxel(found.points_m)
    expected = map_coordinates(VOXELS.astype(float), index.T, order=1)
    np.testing.assert_allclose(found.intensity, expected, atol=1e-5)
    assert found.intensity.min() >= np.float32(0.45)
    assert found.intensity.max() <= np.float32(0.55)
    with pytest.raises(QueryError, match="take an InterpolatedField"):
        find_band(volume, BandQuery(0.45, 0.55, step_m=5e-6))


def test_the_paper_s_bands_share_no_voxel_and_leave_none_out():
    levels = np.linspace(0, 255, 256).astype(np.uint8).reshape(4, 8, 8)
    volume = Volume.from_array(levels, (1e-5, 1e-5, 1e-5))
    counts = [len(find_band(volume, band).points_m) for band in PAPER_BANDS]
    # 51, 102 and 153 are 0.2, 0.4 and 0.6 of 255 exactly: each belongs to the band that begins there.
    assert counts == [51, 51, 103]


def test_both_ends_belong_to_a_band_unless_it_is_half_open():
    levels = np.linspace(0, 1, 9, dtype=np.float32).reshape(1, 3, 3).repeat(2, axis=0)
    volume = Volume.from_array(levels, (1e-5, 1e-5, 1e-5))
    assert len(find_band(volume, BandQuery(0.25, 0.5)).points_m) == 2 * 3
    assert len(find_band(volume, BandQuery(0.25, 0.5, half_open=True)).points_m) == 2 * 2


def test_slabs_leave_no_seam_and_tell_how_far_they_are(volume, monkeypatch):
    whole = find_band(volume, BandQuery(0.3, 0.5))
    monkeypatch.setattr(Lattice.slabs, "__defaults__", (100,))
    shares = []
    parts = find_band(volume, BandQuery(0.3, 0.5), progress=shares.append)
    np.testing.assert_array_equal(parts.points_m, whole.points_m)
    np.testing.assert_array_equal(parts.intensity, whole.intensity)
    np.testing.assert_allclose(shares, np.arange(1, 7) / 6)


def test_an_empty_band_is_an_answer(volume):
    dim = Volume(VOXELS * 0.5, GEOMETRY, (0.0, 1.0))
    found = find_band(dim, BandQuery(0.9, 1.0))
    assert found.points_m.shape == (0, 3)
    assert found.intensity.shape == (0,)


def test_too_many_points_are_refused_with_advice(volume):
    assert len(find_band(volume, BandQuery(0.0, 1.0, max_points=VOXELS.size)).points_m) == VOXELS.size
    with pytest.raises(QueryError, match=r"at most 431 points, got 432 after 6 of 6 planes; take a smaller region"):
        find_band(volume, BandQuery(0.0, 1.0, max_points=VOXELS.size - 1))


@pytest.mark.parametrize(("low", "high"), [(0.5, 0.5), (0.6, 0.4), (-0.1, 0.4), (0.4, float("nan"))])
def test_bands_that_are_none(low, high):
    with pytest.raises(ConfigurationError, match="BandQuery"):
        BandQuery(low, high)


def test_a_neural_field_is_asked_the_same_way(volume):
    torch.manual_seed(0)
    config = NeuralFieldConfig(HashGridConfig(levels=3, features=2, log2_table_size=10), NetworkConfig(2, 16))
    model = NeuralModel(config, GEOMETRY.shape)
    with torch.no_grad():
        model.grid.table.uniform_(-1, 1)
        list(model.parameters())[-1].fill_(0.5)  # the output's bias
    field = NeuralField(model, config, FieldDescription.of_volume(volume, "neural"))
    index = np.stack(np.meshgrid(*map(np.arange, GEOMETRY.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    with torch.no_grad():
        values = field.evaluate(torch.from_numpy(GEOMETRY.voxel_to_canonical(index).astype(np.float32))).numpy()
    low, middle = np.clip(np.sort(values)[[20, len(values) // 2]], 0.0, 1.0).tolist()
    found = find_band(field, BandQuery(low + 1e-5, middle + 1e-5))
    chosen = (values >= low + 1e-5) & (values <= middle + 1e-5)
    np.testing.assert_allclose(found.points_m, GEOMETRY.voxel_to_metric(index[chosen]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.intensity, values[chosen], atol=1e-6)
