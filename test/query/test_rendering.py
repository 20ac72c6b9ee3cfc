import numpy as np
import pytest

from octn_ros.errors import ConfigurationError, QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import Box, RenderConfig, render
from octn_ros.volume import Volume, VolumeGeometry

GEOMETRY = VolumeGeometry((24, 36, 40), (28e-6, 14e-6, 15e-6), (1e-3, -2e-3, 5e-4))
CENTRE = np.array(GEOMETRY.origin_m) + np.array(GEOMETRY.extent_m) / 2
CAMERA = {"pixels": 61, "lattice_points": 30_000, "clear_below": 0.3, "solid_above": 0.8, "opacity_per_mm": 60.0}


def balls(*places):
    """Bright balls (offset from the centre in micrometres, radius in micrometres, intensity) in the dark."""
    index = np.stack(np.meshgrid(*map(np.arange, GEOMETRY.shape), indexing="ij"), axis=-1).astype(float)
    metres = GEOMETRY.voxel_to_metric(index)
    voxels = np.zeros(GEOMETRY.shape)
    for offset_um, radius_um, intensity in places:
        distance = np.linalg.norm(metres - CENTRE - np.array(offset_um) * 1e-6, axis=-1)
        voxels = np.maximum(voxels, intensity * np.clip((radius_um * 1e-6 - distance) / 15e-6 + 0.5, 0, 1))
    return InterpolatedField(Volume(voxels.astype(np.float32), GEOMETRY, (0.0, 1.0)))


def middle_um(picture):
    """Centre of light, as an offset from the scan's centre along the picture's axes in micrometres."""
    rows, columns = np.indices(picture.grey.shape)
    weight = picture.opacity / picture.opacity.sum()
    place = picture.origin_m + picture.step_m * (
        (weight * columns).sum() * picture.right + (weight * rows).sum() * picture.down
    )
    return (place - CENTRE) @ picture.right * 1e6, (place - CENTRE) @ picture.down * 1e6


@pytest.mark.parametrize(
    ("azimuth", "elevation", "right", "down"),
    [
        (0.0, 0.0, (1, 0, 0), (0, 0, 1)),  # as a B-scan
        (0.0, 90.0, (1, 0, 0), (0, 1, 0)),  # as an en-face view
        (90.0, 0.0, (0, 1, 0), (0, 0, 1)),
        (180.0, 0.0, (-1, 0, 0), (0, 0, 1)),
        (30.0, 35.0, None, None),
    ],
)
def test_a_bright_ball_appears_where_it_should(azimuth, elevation, right, down):
    offset = np.array([90.0, 150.0, -70.0])
    config = RenderConfig(azimuth, elevation, **CAMERA)
    picture = render(balls((offset, 60.0, 1.0)), config)
    if right:
        np.testing.assert_allclose([picture.right, picture.down], [right, down], atol=1e-12)
    assert middle_um(picture) == pytest.approx((offset @ picture.right, offset @ picture.down), abs=8.0)
    assert picture.grey.shape == (61, 61)
    # It covers a disc of its size, and nothing else.
    disc_um2 = (picture.opacity > 0.5).sum() * (picture.step_m * 1e6) ** 2
    assert disc_um2 == pytest.approx(np.pi * 60.0**2, rel=0.25)
    assert picture.grey[0, 0] == 0.0


def test_the_camera_is_no_mirror():
    for azimuth, elevation in ((0, 0), (30, 35), (200, -60), (0, 90)):
        right, down, forward = RenderConfig(float(azimuth), float(elevation)).camera_axes()
        # x right, y down, z away from the viewer is right-handed, as is the OCT frame.
        assert np.linalg.det([right, down, forward]) == pytest.approx(1.0)


def test_what_is_in_front_hides_what_is_behind():
    config = RenderConfig(0.0, 0.0, **CAMERA)
    # Looking along -y: the larger y is nearer. The two differ in brightness.
    bright, dim = 1.0, 0.6
    hidden = render(balls(((0, 200, 0), 80.0, dim), ((0, -200, 0), 80.0, bright)), config)
    shown = render(balls(((0, 200, 0), 80.0, bright), ((0, -200, 0), 80.0, dim)), config)
    alone = render(balls(((0, 200, 0), 80.0, bright)), config)
    middle = 30, 30
    assert shown.grey[middle] == pytest.approx(alone.grey[middle], abs=0.02)
    assert hidden.grey[middle] < 0.85 * shown.grey[middle]
    # Seen from the other side the bright one is in front.
    turned = render(balls(((0, 200, 0), 80.0, dim), ((0, -200, 0), 80.0, bright)),
                    RenderConfig(180.0, 0.0, **CAMERA))  # fmt: skip
    assert turned.grey[middle] == pytest.approx(shown.grey[middle], abs=0.02)


def test_the_same_picture_twice_and_the_progress_told():
    shares = []
    field = balls(((0, 0, 0), 100.0, 1.0))
    first = render(field, RenderConfig(**CAMERA), progress=shares.append)
    np.testing.assert_array_equal(first.grey, render(field, RenderConfig(**CAMERA)).grey)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_air_and_tissue_are_told_apart_if_no_levels_are_given():
    field = balls(((0, 0, 0), 150.0, 0.5))
    picture = render(field, RenderConfig(0.0, 0.0, pixels=61, lattice_points=30_000))
    assert picture.opacity[30, 30] > 0.9
    assert picture.opacity[2, 2] < 0.01


def test_a_region_alone_is_drawn():
    field = balls(((-120, 0, 0), 60.0, 1.0), ((120, 0, 0), 60.0, 1.0))
    half = Box((CENTRE[0], -1.0, -1.0), (1.0, 1.0, 1.0))
    picture = render(field, RenderConfig(0.0, 0.0, **CAMERA), half)
    right, down = middle_um(picture)
    assert (right, down) == pytest.approx((120.0, 0.0), abs=8.0)
    with pytest.raises(QueryError, match="touches the scan"):
        render(field, RenderConfig(), Box((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)))


def test_levels_out_of_order():
    with pytest.raises(ConfigurationError, match="clear_below < solid_above"):
        RenderConfig(clear_below=0.5, solid_above=0.4)
