import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import SliceSpec, surface_map
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import Volume

VOXELS = np.random.default_rng(1).random((6, 8, 7), dtype=np.float32)
SPACING_M, ORIGIN_M = (3e-5, 1e-5, 2e-5), (1e-3, 2e-3, 3e-3)


@pytest.fixture(scope="module")
def field():
    return InterpolatedField(Volume.from_array(VOXELS, SPACING_M, origin_m=ORIGIN_M))


@pytest.fixture(scope="module")
def phantom():
    return make_phantom(PhantomConfig(shape=(24, 96, 48), surface="tilted", tilt_deg=5.0))


def test_words_and_numbers():
    assert SliceSpec.parse("bscan:128.5") == SliceSpec("bscan", "", (128.5,))
    assert SliceSpec.parse(" enface : depth ") == SliceSpec("enface", "depth")
    assert SliceSpec.parse("render:30,-20").numbers == (30.0, -20.0)
    plane = SliceSpec.parse("plane:1,2,3; 1,0,0; 0,0,1; 0.5,0.25").plane(1e-5)
    assert plane.origin_m == pytest.approx((1e-3, 2e-3, 3e-3))
    assert plane.size_m == pytest.approx((0.5e-3, 0.25e-3))
    assert plane.step_m == 1e-5
    assert SliceSpec.parse("plane:1,2,3;1,0,0;0,0,1;0.5,0.25;0.02").plane(1e-5).step_m == pytest.approx(2e-5)


@pytest.mark.parametrize(
    "text",
    ["bscan:2.5", "axial:0", "enface:mip", "layer:0.1,0.3", "plane:1,2,3;1,0,0;0,0,1;0.5,0.25;0.02", "render:30,35"],
)
def test_a_specification_is_written_as_it_is_read(text):
    assert str(SliceSpec.parse(text)) == text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a slice as bscan:POSITION"),
        ("bscan", "expected a slice as"),
        ("cscan:3", "expected a slice as"),
        ("bscan:", "expected bscan:POSITION"),
        ("bscan:one", "expected bscan:POSITION, got 'bscan:one'"),
        ("bscan:nan", "expected bscan:POSITION"),
        ("bscan:1,2", "expected bscan:POSITION"),
        ("enface:max", "enface:mip, enface:mean or enface:depth"),
        ("layer:0.1", "layer:FROM,TO"),
        ("plane:1,2,3;1,0,0;0,0,1", "plane:X,Y,Z"),
        ("plane:1,2,3,1,0,0,0,0,1,1,1", "plane:X,Y,Z"),
        ("render:30", "render:AZIMUTH"),
    ],
)
def test_specifications_that_are_none(text, words):
    with pytest.raises(QueryError, match=words):
        SliceSpec.parse(text)


def value_at(image, row, column):
    """Voxel value at the place that a pixel states."""
    place = np.array(image.origin_m) + row * np.array(image.down_m) + column * np.array(image.along_m)
    lateral, bscan, axial = (place - ORIGIN_M) / np.array([SPACING_M[2], SPACING_M[0], SPACING_M[1]])
    index = np.array([bscan, axial, lateral])
    assert np.abs(index - index.round()).max() < 1e-6
    return VOXELS[tuple(index.round().astype(int))]


@pytest.mark.parametrize(
    "text", ["bscan:2", "axial:3", "lateral:4", "plane:1.06,2.12,3.02;0,-1,0;0,0,2;0.09,0.03;0.03"]
)
def test_pixels_lie_where_they_say(field, text):
    image = SliceSpec.parse(text).evaluate(field)
    assert image.quantity == "intensity"
    rows, columns = image.pixels.shape
    for row, column in ((0, 0), (1, 0), (0, 1), (rows - 1, columns - 1)):
        assert image.pixels[row, column] == pytest.approx(value_at(image, row, column), abs=1e-4)


def test_views_along_the_beam(field):
    for mode, along_beam in (("mip", np.max), ("mean", np.mean)):
        image = SliceSpec("enface", mode).evaluate(field)
        np.testing.assert_allclose(image.pixels, along_beam(VOXELS, axis=1), atol=1e-5)
        assert image.along_m == pytest.approx((2e-5, 0, 0))
        assert image.down_m == pytest.approx((0, 3e-5, 0))
        assert image.origin_m == pytest.approx(ORIGIN_M)


def test_depth_and_layers_follow_the_surface(phantom):
    field = InterpolatedField(phantom.truth)
    depth = SliceSpec.parse("enface:depth").evaluate(field)
    assert depth.quantity == "depth_m"
    surface = surface_map(field)
    np.testing.assert_allclose(depth.pixels, surface.depth_m, rtol=1e-6)
    truth = phantom.surface_depth_m(surface.lateral_m, surface.bscan_m[:, None])
    assert np.abs(depth.pixels - truth).max() < 20e-6
    air = SliceSpec.parse("layer:-0.2,-0.1").evaluate(field).pixels
    tissue = SliceSpec.parse("layer:0.05,0.15").evaluate(field).pixels
    assert np.nanmax(air) < np.nanmin(tissue)


def test_a_rendering(phantom):
    shares = []
    image = SliceSpec.parse("render:0,90").evaluate(InterpolatedField(phantom.truth), progress=shares.append)
    assert image.quantity == "light"
    assert 0.1 < image.pixels.max() <= 1.0
    assert shares[-1] == 1.0
