import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import Plane, axial_slice, bscan_slice, lateral_slice, plane_slice
from octn_ros.volume import Volume, VolumeGeometry

VOXELS = np.random.default_rng(1).integers(0, 256, (5, 7, 6), dtype=np.uint8)


@pytest.fixture
def volume():
    return Volume.from_array(VOXELS, (1e-5, 1e-5, 1e-5))


def test_whole_positions_return_the_acquired_bscans(volume):
    field = InterpolatedField(volume)
    for index in range(5):
        image = bscan_slice(field, index)
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, VOXELS[index] / 255.0, atol=1e-5)


def test_fractional_positions_lie_between(volume):
    expected = (0.75 * VOXELS[2] + 0.25 * VOXELS[3]) / 255.0
    np.testing.assert_allclose(bscan_slice(InterpolatedField(volume), 2.25), expected, atol=1e-5)


@pytest.mark.parametrize("position", [-0.01, 4.01, float("nan"), float("inf")])
def test_positions_outside_the_scan(volume, position):
    with pytest.raises(QueryError, match="from 0 to 4, got"):
        bscan_slice(InterpolatedField(volume), position)


@pytest.mark.parametrize("position", [0, 3, 2.25])
def test_cuts_across_the_other_axes(volume, position):
    field = InterpolatedField(volume)
    low, share = int(position), position - int(position)
    high = min(low + 1, 5)
    axial = ((1 - share) * VOXELS[:, low] + share * VOXELS[:, high]) / 255.0
    np.testing.assert_allclose(axial_slice(field, position), axial, atol=1e-5)
    lateral = ((1 - share) * VOXELS[:, :, low] + share * VOXELS[:, :, high]) / 255.0
    np.testing.assert_allclose(lateral_slice(field, position), lateral.T, atol=1e-5)
    with pytest.raises(QueryError, match=r"axial position from 0 to 6, got 6\.5"):
        axial_slice(field, 6.5)
    with pytest.raises(QueryError, match="lateral position from 0 to 5, got -1"):
        lateral_slice(field, -1)


def test_a_plane_along_the_axes_is_a_bscan():
    volume = Volume.from_array(VOXELS, (3e-5, 1e-5, 1e-5), origin_m=(1e-3, 2e-3, 3e-3))
    field = InterpolatedField(volume)
    plane = Plane((1e-3, 2e-3 + 1.5 * 3e-5, 3e-3), (2.0, 0, 0), (0, 0, 0.1), (5e-5, 6e-5), 1e-5)
    assert plane.shape == (7, 6)
    np.testing.assert_allclose(plane_slice(field, plane), bscan_slice(field, 1.5), atol=1e-4)


def ramp():
    """A field whose intensity is a x + b y + c z + d exactly, so that any cut is known."""
    geometry = VolumeGeometry((12, 16, 20), (28e-6, 14.59e-6, 14e-6), (1e-3, -2e-3, 5e-4))
    index = np.stack(np.meshgrid(*map(np.arange, geometry.shape), indexing="ij"), axis=-1).astype(float)
    slope = np.array([900.0, 700.0, 1100.0])
    centre = np.array(geometry.origin_m) + np.array(geometry.extent_m) / 2
    voxels = 0.5 + (geometry.voxel_to_metric(index) - centre) @ slope
    assert 0 < voxels.min() < voxels.max() < 1
    return InterpolatedField(Volume(voxels.astype(np.float32), geometry, (0.0, 1.0))), slope, centre


def test_an_oblique_plane_lies_where_it_says_and_is_nan_outside():
    field, slope, centre = ramp()
    along, down = np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([1.0, -1.0, 2.0]) / np.sqrt(6)
    origin = centre - 2e-4 * along - 1.5e-4 * down
    plane = Plane(tuple(origin), tuple(along), tuple(down), (4e-4, 3e-4), 8e-6)
    picture = plane_slice(field, plane)
    assert picture.shape == (38, 51)
    rows, columns = np.indices(picture.shape)
    points = origin + 8e-6 * (columns[..., None] * along + rows[..., None] * down)
    np.testing.assert_allclose(plane.points_m(), points, rtol=0, atol=1e-15)
    low = np.array(field.geometry.origin_m)
    inside = ((points >= low) & (points <= low + field.geometry.extent_m)).all(axis=-1)
    assert 0.2 < inside.mean() < 0.95
    np.testing.assert_array_equal(np.isfinite(picture), inside)
    np.testing.assert_allclose(picture[inside], (0.5 + (points - centre) @ slope)[inside], atol=1e-5)


def test_directions_are_made_square_or_refused():
    plane = Plane((0, 0, 0), (1, 0, 0), (5e-4, 0, 3.0), (1e-3, 1e-3), 1e-4)
    assert np.dot(plane.along, plane.down) == pytest.approx(0.0, abs=1e-15)
    assert np.linalg.norm(plane.down) == pytest.approx(1.0)
    for down, words in (((1, 0, 1), "45.00 degrees"), ((0, 0, 0), "two directions"), ((0, 0, np.nan), "finite")):
        with pytest.raises(QueryError, match=words):
            Plane((0, 0, 0), (1, 0, 0), down, (1e-3, 1e-3), 1e-4)
    for size, step in (((-1e-3, 1e-3), 1e-4), ((1e-3, 1e-3), 0.0)):
        with pytest.raises(QueryError, match="step above 0"):
            Plane((0, 0, 0), (1, 0, 0), (0, 1, 0), size, step)
    with pytest.raises(QueryError, match="larger step"):
        Plane((0, 0, 0), (1, 0, 0), (0, 1, 0), (1.0, 1.0), 1e-9)


def test_a_plane_beside_the_scan(volume):
    plane = Plane((1.0, 0, 0), (1, 0, 0), (0, 1, 0), (1e-5, 1e-5), 1e-5)
    with pytest.raises(QueryError, match="cuts the scan"):
        plane_slice(InterpolatedField(volume), plane)
