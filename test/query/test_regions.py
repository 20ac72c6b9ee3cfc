import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.query import Box, EnfacePolygon, Lattice, Sphere, polygon
from octn_ros.volume import VolumeGeometry

BOX = Box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
L_SHAPE = [(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)]


def inside(region, *points):
    return region.contains(*np.array(points, dtype=float).T).tolist()


def test_a_box_has_its_borders():
    assert inside(BOX, (0, 0, 0), (1, 2, 3), (0.5, 1, 1.5), (1.001, 1, 1), (0.5, -0.001, 1), (0.5, 1, 3.1)) == [
        *(True, True, True),
        *(False, False, False),
    ]


def test_a_sphere():
    sphere = Sphere((1.0, 2.0, 3.0), 0.5)
    assert inside(sphere, (1.5, 2, 3), (1, 2.49, 3), (1.4, 2.4, 3), (1, 2, 2.4)) == [True, True, False, False]
    low, high = sphere.bounds_m()
    np.testing.assert_array_equal([low, high], [[0.5, 1.5, 2.5], [1.5, 2.5, 3.5]])


@pytest.mark.parametrize("corners", [L_SHAPE, L_SHAPE[::-1], [*L_SHAPE, L_SHAPE[0]]])
def test_a_polygon_that_is_not_convex_either_way_round(corners):
    region = polygon(corners)
    points = [(0.5, 3.5, 9.0), (3.5, 0.5, -9.0), (0.5, 0.5, 0.0), (2.0, 2.0, 0.0), (5.0, 0.5, 0.0)]
    assert inside(region, *points) == [True, True, True, False, False]
    assert region.bounds_m()[0].tolist() == [0.0, 0.0, -np.inf]


def test_regions_combine_and_so_do_their_bounds():
    ball = Sphere((1.0, 1.0, 1.0), 0.5)
    assert inside(BOX & ball, (0.9, 1, 1), (1.2, 1, 1), (0.1, 1, 1)) == [True, False, False]
    assert inside(BOX | ball, (0.9, 1, 1), (1.2, 1, 1), (1.6, 1, 1)) == [True, True, False]
    assert inside(BOX & ~ball, (0.9, 1, 1), (0.1, 1, 1), (1.6, 1, 1)) == [False, True, False]
    np.testing.assert_array_equal((BOX & ball).bounds_m(), [[0.5, 0.5, 0.5], [1.0, 1.5, 1.5]])
    np.testing.assert_array_equal((BOX | ball).bounds_m(), [[0.0, 0.0, 0.0], [1.5, 2.0, 3.0]])
    np.testing.assert_array_equal((BOX & ~ball).bounds_m(), BOX.bounds_m())


@pytest.mark.parametrize("region", [BOX, Sphere((0.5, 1.0, 1.5), 0.6), polygon(L_SHAPE), ~BOX, BOX | polygon(L_SHAPE)])
def test_axes_of_a_lattice_and_single_points_agree(region):
    rng = np.random.default_rng(0)
    x, y, z = rng.uniform(-1, 4, 6), rng.uniform(-1, 4, 5), rng.uniform(-1, 4, 7)
    grid = np.broadcast_to(region.contains(x[None, None, :], y[:, None, None], z[None, :, None]), (5, 7, 6))
    y3, z3, x3 = np.meshgrid(y, z, x, indexing="ij")
    np.testing.assert_array_equal(grid, region.contains(x3, y3, z3))
    low, high = region.bounds_m()
    held = np.stack([x3, y3, z3], axis=-1)[grid]
    assert ((held >= low) & (held <= high)).all()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Box((0, 0, 0), (1, 0, 1)), "low < high"),
        (lambda: Box((0, 0, 0), (1, float("nan"), 1)), "low < high"),
        (lambda: Box((0, 0), (1, 1)), "corners"),
        (lambda: Sphere((0, 0, 0), 0.0), "radius above 0"),
        (lambda: Sphere((0, 0, float("inf")), 1.0), "finite centre"),
        (lambda: EnfacePolygon(((0, 0), (1, 1))), "three or more"),
        (lambda: polygon([(0, 0), (1, 1), (2, 2)]), "on one line"),
        (lambda: polygon([(0, 0), (1, 1), (float("nan"), 2)]), "finite corners"),
    ],
)
def test_regions_that_are_none(make, words):
    with pytest.raises(QueryError, match=words):
        make()


GEOMETRY = VolumeGeometry((5, 7, 6), (2e-5, 1e-5, 3e-5), (1e-3, 2e-3, -1e-3))


def test_the_voxels_are_the_lattice_unless_a_step_is_given():
    lattice = Lattice.over(GEOMETRY, name="test")
    assert lattice.shape == (5, 7, 6)
    assert lattice.native
    x, y, z = lattice.axes_m()
    index = np.stack(np.meshgrid(np.arange(5), np.arange(7), np.arange(6), indexing="ij"), axis=-1)
    expected = GEOMETRY.voxel_to_metric(index)
    got = np.stack(np.broadcast_arrays(x[None, None, :], y[:, None, None], z[None, :, None]), axis=-1)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-15)


def test_a_region_keeps_the_lattice_points_that_it_may_touch():
    whole = Lattice.over(GEOMETRY, step_m=7e-6, name="test")
    region = Box((1.02e-3, 2.03e-3, -9.8e-4), (1.09e-3, 9.0, -9.6e-4))
    part = Lattice.over(GEOMETRY, region, 7e-6, name="test")
    for got, all_of_them, low, high in zip(part.axes_m(), whole.axes_m(), *region.bounds_m(), strict=True):
        expected = all_of_them[(all_of_them >= low) & (all_of_them <= high)]
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("region", "step_m", "words"),
    [
        (Box((0, 0, 0), (1e-4, 1e-4, 1e-4)), None, "touches the scan"),
        (Sphere((1.015e-3, 2e-3, -1e-3), 1e-6), None, "between them"),
        (None, 0.0, "step above 0"),
        (None, float("nan"), "step above 0"),
        (None, 1e-13, "along an axis"),
        (None, 1e-9, "larger step"),
    ],
)
def test_lattices_that_are_none(region, step_m, words):
    with pytest.raises(QueryError, match=words):
        Lattice.over(GEOMETRY, region, step_m, name="test")
