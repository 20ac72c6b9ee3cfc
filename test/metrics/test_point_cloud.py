import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octn_ros.errors import QueryError
from octn_ros.metrics import chamfer_m, cloud_distance, hausdorff_m

FIRST = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
SECOND = np.array([[0.0, 0.0, 1.0], [0.0, 4.0, 0.0], [3.0, 0.0, 0.0]])


def test_both_distances_by_hand():
    # From the first: to (0, 0, 1) 1, to itself 0: sum 1, times 1 / (2 * 2) = 1/4.
    # From the second: 1, 4 (to the origin; (3, 0, 0) is 5 away), 0: sum 5, times 1 / (2 * 3) = 5/6.
    assert chamfer_m(FIRST, SECOND) == pytest.approx(1 / 4 + 5 / 6)
    # The largest of 1, 0, 1, 4, 0.
    assert hausdorff_m(FIRST, SECOND) == pytest.approx(4.0)


def test_equal_clouds_do_not_differ_and_single_points_are_enough():
    assert cloud_distance(FIRST, FIRST[::-1]) == (0.0, 0.0)
    assert cloud_distance(FIRST[:1], FIRST[1:]) == (pytest.approx(3.0), pytest.approx(3.0))


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40))
def test_symmetric_and_chamfer_below_hausdorff(seed, first, second):
    generator = np.random.default_rng(seed)
    one, other = generator.normal(size=(first, 3)), generator.normal(size=(second, 3))
    there, back = cloud_distance(one, other), cloud_distance(other, one)
    assert there == pytest.approx(back)
    assert 0.0 < there.chamfer_m <= there.hausdorff_m + 1e-12


def test_many_points_are_sampled_by_the_seed():
    generator = np.random.default_rng(0)
    one, other = generator.random((5000, 3)), generator.random((4000, 3))
    full, sampled = cloud_distance(one, other), cloud_distance(one, other, max_points=500)
    assert sampled == cloud_distance(one, other, max_points=500)
    assert sampled != cloud_distance(one, other, max_points=500, seed=1)
    assert sampled == pytest.approx(cloud_distance(other, one, max_points=500))
    # Nearest neighbours are exact: sampling neither raises the mean, as thinning would (to twice), nor the largest.
    assert sampled.chamfer_m == pytest.approx(full.chamfer_m, rel=0.05)
    assert sampled.hausdorff_m <= full.hausdorff_m
    assert cloud_distance(one, other, max_points=5000) == full


def test_the_order_of_points_does_not_matter_however_many_there_are():
    cloud = np.random.default_rng(0).random((3000, 3))
    permuted = np.random.default_rng(1).permutation(cloud)
    assert cloud_distance(cloud, permuted, max_points=300) == (0.0, 0.0)
    # The same distance for every point, so that whichever are drawn, it is their mean: 1e-4 along z.
    moved = cloud_distance(cloud, permuted + np.array([0.0, 0.0, 1e-4]), max_points=300)
    assert moved.chamfer_m == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("first", "second", "most"),
    [
        (np.zeros((0, 3)), FIRST, 10),
        (FIRST, np.zeros((4, 2)), 10),
        (FIRST, np.full((4, 3), np.inf), 10),
        (FIRST, SECOND, 0),
    ],
)
def test_clouds_that_cannot_be_compared(first, second, most):
    with pytest.raises(QueryError, match="point clouds: expected"):
        cloud_distance(first, second, most)
