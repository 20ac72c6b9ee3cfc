import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.metrics import summarise_distance, surface_distance


def plane(x, y):
    return 1e-3 + x + 0.0 * y  # 45 degrees


def points_above(offset_m):
    x, y = np.meshgrid(np.linspace(0, 1e-3, 7), np.linspace(0, 1e-3, 5))
    return np.stack([x.ravel(), y.ravel(), plane(x, y).ravel() + offset_m], axis=1)


def test_distance_is_perpendicular_and_signed():
    result = surface_distance(points_above(-20e-6), plane)
    assert result.offset_um == pytest.approx(-20 / np.sqrt(2))
    assert result.spread_um == pytest.approx(0.0, abs=1e-6)
    assert result.max_um == pytest.approx(20 / np.sqrt(2))
    assert result.rms_um == pytest.approx(20 / np.sqrt(2))


def test_spread_is_taken_about_the_median():
    points = np.zeros((4, 3))
    points[:, 2] = np.array([1, 1, 1, 5]) * 1e-6
    result = surface_distance(points, lambda x, y: 0 * x)
    assert (result.offset_um, result.max_um) == (pytest.approx(1.0), pytest.approx(5.0))
    assert result.spread_um == pytest.approx(2.0)
    assert result.rms_um == pytest.approx(np.sqrt(7.0))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((4, 2)), np.full((4, 3), np.nan)])
def test_points_that_cannot_be_judged(points):
    with pytest.raises(QueryError, match="expected"):
        surface_distance(points, plane)


def test_summary_of_distances_by_hand():
    # Median of -3, 1, 2, 4 um is 1.5; about it -4.5, -0.5, 0.5, 2.5: squares 20.25 + 0.25 + 0.25 + 6.25 = 27.
    result = summarise_distance(np.array([4.0, -3.0, 1.0, 2.0]) * 1e-6)
    assert result.offset_um == pytest.approx(1.5)
    assert result.spread_um == pytest.approx(np.sqrt(27 / 4))
    assert result.max_um == pytest.approx(4.0)
    assert result.rms_um == pytest.approx(np.sqrt(30 / 4))
