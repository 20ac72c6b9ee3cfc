import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from octn_ros.errors import ConfigurationError, PlanError
from octn_ros.planning import RasterConfig, count_waypoints, rectangle_corners, rectangle_raster, rectangle_region


def test_small_raster_by_hand():
    pattern = rectangle_raster((0.0, 0.0), (2e-4, 1e-4), 0.0, RasterConfig(100e-6, 100e-6))
    expected = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1)]
    np.testing.assert_allclose(pattern.points_m, np.array(expected) * 1e-4, atol=1e-15)
    assert pattern.segment.tolist() == [0, 0, 0, 1, 1, 1]
    assert pattern.segment.dtype == np.int32


def test_the_paper_raster_has_61_lines_of_61_points():
    pattern = rectangle_raster((0.0, 0.0), (3e-3, 3e-3))
    assert pattern.points_m.shape == (61 * 61, 2)


def test_a_quarter_turn_starts_along_the_bscan_axis():
    pattern = rectangle_raster((0.0, 0.0), (2e-4, 1e-4), math.pi / 2, RasterConfig(100e-6, 100e-6))
    np.testing.assert_allclose(pattern.points_m[:2], [(0, 0), (0, 1e-4)], atol=1e-15)
    assert pattern.segment.max() == 2


millimetres = st.floats(-2e-3, 2e-3)


@example((0.0, 0.002), (0.002, 0.0), 2.225073858507e-311, 3e-4, 2.5e-4)  # an edge of next to no height
@given(
    st.tuples(millimetres, millimetres), st.tuples(millimetres, millimetres), st.floats(-7.0, 7.0),
    st.floats(3e-5, 3e-4), st.floats(3e-5, 3e-4),
)  # fmt: skip
def test_coverage_of_any_rectangle(corner, opposite, angle, line_spacing, point_spacing):
    try:
        corners = rectangle_corners(corner, opposite, angle)
    except PlanError:
        return  # no rectangle
    pattern = rectangle_raster(corner, opposite, angle, RasterConfig(line_spacing, point_spacing))
    lines = np.split(pattern.points_m, np.flatnonzero(np.diff(pattern.segment)) + 1)
    side, other = corners[1] - corners[0], corners[3] - corners[0]
    across = other / np.linalg.norm(other)
    offsets = np.array([(line - corners[0]) @ across for line in lines])
    # Each line is straight, neighbours are no further apart than asked, first and last lie on the edges.
    assert np.ptp(offsets, axis=1).max() < 1e-12
    gaps = np.diff(offsets[:, 0])
    assert (gaps > 0).all()
    assert gaps.max() <= line_spacing * (1 + 1e-6)
    assert offsets[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert offsets[-1, 0] == pytest.approx(np.linalg.norm(other), abs=1e-12)
    for number, line in enumerate(lines):
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        assert steps.max() <= point_spacing * (1 + 1e-6)
        ends = (line[0], line[-1]) if number % 2 == 0 else (line[-1], line[0])
        shift = offsets[number, 0] * across
        np.testing.assert_allclose(ends, [corners[0] + shift, corners[0] + side + shift], atol=1e-12)
    # The first side makes the given angle with the lateral axis, up to its direction.
    assert abs(side @ [-math.sin(angle), math.cos(angle)]) < 1e-12
    np.testing.assert_allclose(corners[2], opposite)


@pytest.mark.parametrize(
    ("corner", "opposite", "angle", "words"),
    [
        ((math.nan, 0.0), (1e-3, 1e-3), 0.0, "finite numbers, got corners .*nan"),
        ((0.0, 0.0), (math.inf, 1e-3), 0.0, "finite numbers"),
        ((0.0, 0.0), (1e-3, 1e-3), math.nan, "angle nan"),
        ((0.0, 0.0), (0.0, 0.0), 0.0, "two sides, got 0 x 0 mm"),
        ((0.0, 0.0), (1e-3, 0.0), 0.0, "two sides, got 1 x 0 mm"),
        ((0.0, 0.0), (1e-3, 1e-3), math.pi / 4, "two sides"),
        ((0.0, 0.0, 0.0), (1e-3, 1e-3), 0.0, "two corners"),
    ],
)
def test_rectangles_that_are_none(corner, opposite, angle, words):
    with pytest.raises(PlanError, match=words):
        rectangle_raster(corner, opposite, angle)


@pytest.mark.parametrize("spacing", [math.nan, math.inf, 0.0, -50e-6, 1e-300])
def test_spacings_that_are_none(spacing):
    with pytest.raises(ConfigurationError, match=r"RasterConfig\.line_spacing_m: expected"):
        RasterConfig(line_spacing_m=spacing)
    with pytest.raises(ConfigurationError, match=r"RasterConfig\.point_spacing_m: expected"):
        RasterConfig(point_spacing_m=spacing)


def test_more_than_a_million_waypoints_are_refused_before_they_are_made():
    words = r"at most 1,000,000 waypoints, got 3e\+04 lines of 3e\+04: 3\.000 mm at a line spacing of 0\.1 um"
    with pytest.raises(PlanError, match=words):
        rectangle_raster((0.0, 0.0), (3e-3, 3e-3), config=RasterConfig(1e-7, 1e-7))
    with pytest.raises(PlanError, match=words):
        count_waypoints(rectangle_region((0.0, 0.0), (3e-3, 3e-3)), RasterConfig(1e-7, 1e-7))


def test_a_million_waypoints_are_just_allowed():
    config = RasterConfig(line_spacing_m=1e-3 / 999, point_spacing_m=1e-3 / 999)
    assert len(rectangle_raster((0.0, 0.0), (1e-3, 1e-3), config=config).points_m) == 1_000_000
    config = RasterConfig(line_spacing_m=1e-3 / 1000, point_spacing_m=1e-3 / 999)
    with pytest.raises(PlanError, match=r"1,000,000 waypoints, got 1001 lines of 1000"):
        rectangle_raster((0.0, 0.0), (1e-3, 1e-3), config=config)
