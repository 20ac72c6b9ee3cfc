"""Regions, the raster in them, and the coverage figures: any rectangle, any simple polygon, any angle."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from octn_ros.errors import ConfigurationError, PlanError
from octn_ros.planning import (
    RasterConfig,
    Region,
    centred_rectangle_region,
    count_waypoints,
    measure_coverage,
    polygon_region,
    raster_pattern,
    rectangle_raster,
    rectangle_region,
)
from octn_ros.planning.region_config import RegionConfig
from octn_ros.volume import VolumeGeometry

# An L, whose lines across the notch fall into two pieces when they run upright.
ELL = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]) * 1e-3
# A U: two arms.
YOU = np.array([(0, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)]) * 1e-3

spacings = st.floats(3e-5, 3e-4)
angles = st.floats(-7.0, 7.0)
margins = st.sampled_from([0.0, 2e-5, 8e-5])
orders = st.sampled_from(["zigzag", "one-way"])


def inside_by_hand(points, corners, margin):
    """Whether points lie in a polygon, and no nearer to any edge than the margin: edge by edge."""
    x, y = points.T
    inside, nearest = np.zeros(len(points), dtype=bool), np.full(len(points), np.inf)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if start[1] != end[1]:
            between = (start[1] <= y) != (end[1] <= y)
            inside ^= between & (x < start[0] + (y - start[1]) / (end[1] - start[1]) * (end[0] - start[0]))
        share = np.clip((points - start) @ (end - start) / np.sum((end - start) ** 2), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - start - share[:, None] * (end - start), axis=1))
    return (inside & (nearest >= margin - 1e-9)) | ((margin == 0.0) & (nearest < 1e-8))


def check_coverage(region, config):
    pattern = raster_pattern(region, config)
    assert count_waypoints(region, config) == len(pattern.points_m)
    figures = measure_coverage(region.inset(config.margin_m), pattern.points_m, pattern.segment, config.line_spacing_m)
    slack = 1.0 + 1e-4  # columns stand a nanometre beside the ends of lines
    assert figures.line_gap_m <= config.line_spacing_m * slack
    assert figures.border_gap_m <= config.line_spacing_m * slack
    assert figures.point_gap_m <= config.point_spacing_m * (1 + 1e-6)
    assert figures.open_share == 0.0
    assert inside_by_hand(pattern.points_m, region.vertices_m, config.margin_m).all()
    return pattern, figures


@settings(max_examples=50)
@given(
    st.tuples(st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3)), st.tuples(st.floats(3e-4, 2e-3), st.floats(3e-4, 2e-3)),
    angles, spacings, spacings, margins, orders,
)  # fmt: skip
def test_no_gap_in_a_rectangle_is_wider_than_the_line_spacing(centre, size, angle, lines, points, margin, order):
    region = centred_rectangle_region(centre, size, angle)
    config = RasterConfig(lines, points, order=order, margin_m=margin)
    _, figures = check_coverage(region, config)
    assert figures.border_gap_m < 1e-8  # the first and the last line, and the ends of all, lie on the border
    assert figures.area_m2 == pytest.approx((size[0] - 2 * margin) * (size[1] - 2 * margin), rel=1e-4)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(3e-4, 1.5e-3)), min_size=5, max_size=12),
    angles, spacings, margins, orders,
)  # fmt: skip
def test_no_gap_in_a_star_shaped_polygon_is_wider_than_the_line_spacing(rays, angle, spacing, margin, order):
    share = (np.arange(len(rays)) + 0.9 * np.array([ray[0] for ray in rays])) / len(rays)
    radius = np.array([ray[1] for ray in rays])
    corners = radius[:, None] * np.column_stack([np.cos(2 * np.pi * share), np.sin(2 * np.pi * share)])
    try:
        region = polygon_region(corners, angle)
        region.inset(margin).line_range()
    except PlanError:
        return  # a spike that meets itself, or nothing left
    check_coverage(region, RasterConfig(spacing, spacing, order=order, margin_m=margin))


@pytest.mark.parametrize("corners", [ELL, YOU, ELL[::-1], np.vstack([YOU, YOU[:1]])])
@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 2, 2.5])
@pytest.mark.parametrize("margin", [0.0, 7e-5])
def test_concave_polygons(corners, angle, margin):
    region = polygon_region(corners, angle)
    pattern, figures = check_coverage(region, RasterConfig(9e-5, 1.1e-4, margin_m=margin))
    assert figures.lines == pattern.segment[-1] + 1
    if margin == 0.0:
        expected = 3e-6 if len(region.vertices_m) == 6 else 5e-6
        assert figures.area_m2 == pytest.approx(expected, rel=0.01)


def test_a_line_over_a_notch_falls_into_pieces_in_the_order_of_travel():
    pattern = raster_pattern(polygon_region(YOU), RasterConfig(5e-4, 5e-4))
    last = pattern.points_m[np.isclose(pattern.points_m[:, 1], 2e-3)]
    assert [tuple(p) for p in (last * 1e3).round(6).tolist()] == [
        (0.0, 2.0), (0.5, 2.0), (1.0, 2.0), (2.0, 2.0), (2.5, 2.0), (3.0, 2.0)
    ]  # fmt: skip
    back = pattern.points_m[np.isclose(pattern.points_m[:, 1], 1.5e-3)]
    assert back[0, 0] == pytest.approx(3e-3)
    assert back[-1, 0] == pytest.approx(0.0)
    assert len(np.unique(pattern.segment)) == 2 + 3 * 2  # five lines; at the notch's floor and above in two pieces


def test_one_way_lines_all_run_like_the_first():
    pattern = rectangle_raster((0.0, 0.0), (1e-3, 5e-4), 0.0, RasterConfig(1e-4, 1e-4, order="one-way"))
    same = np.diff(pattern.segment) == 0
    assert (np.diff(pattern.points_m[:, 0])[same] > 0).all()


def test_margin_is_a_smaller_rectangle():
    region = rectangle_region((0.0, 0.0), (1e-3, 5e-4), 0.0)
    inner = raster_pattern(region, RasterConfig(5e-5, 5e-5, margin_m=1e-4)).points_m
    np.testing.assert_allclose([inner.min(axis=0), inner.max(axis=0)], [(1e-4, 1e-4), (9e-4, 4e-4)], atol=2e-9)
    with pytest.raises(PlanError, match="margin leaves nothing"):
        raster_pattern(region, RasterConfig(margin_m=2.6e-4))


@settings(max_examples=30)
@given(angles, st.floats(0.1, 2.0), spacings)
@example(5.5, 2.0, 0.00021567345378508359)  # where steps of equal length along the samples were 0.1 % too long
def test_points_are_spread_by_distance_on_the_surface(angle, steepness, spacing):
    region = centred_rectangle_region((0.0, 0.0), (1e-3, 6e-4), angle)

    def depth(places):
        return 1e-3 + steepness * places[:, 0] + 5e-5 * np.sin(places[:, 1] / 1e-4)

    pattern = raster_pattern(region, RasterConfig(1e-4, spacing), depth)
    places = np.column_stack([pattern.points_m, depth(pattern.points_m)])
    step = np.linalg.norm(np.diff(places, axis=0), axis=1)[np.diff(pattern.segment) == 0]
    assert step.max() <= spacing * (1 + 1e-6)
    figures = measure_coverage(region, places, pattern.segment, 1e-4)
    assert figures.surface_point_gap_m == pytest.approx(step.max())
    assert figures.surface_line_gap_m >= figures.line_gap_m


def test_gaps_on_a_slope_and_at_lost_points():
    region = rectangle_region((0.0, 0.0), (1e-3, 1e-3))
    pattern = raster_pattern(region, RasterConfig(1e-4, 1e-4))
    points = np.column_stack([pattern.points_m, 0.75 * pattern.points_m[:, 1]])
    figures = measure_coverage(region, points, pattern.segment, 1e-4)
    assert figures.line_gap_m == pytest.approx(1e-4)
    assert figures.surface_line_gap_m == pytest.approx(1.25e-4)  # 3, 4, 5
    assert figures.path_m == pytest.approx(11e-3)
    whole = np.ones(len(points), dtype=bool)
    whole[5 * 11 + 3] = False  # the fourth point of the sixth line
    split = pattern.segment + (np.arange(len(points)) >= 5 * 11 + 4)  # the line falls into two segments
    figures = measure_coverage(region, points[whole], split[whole], 1e-4)
    assert figures.line_gap_m == pytest.approx(2e-4)
    assert figures.lines == 12
    assert figures.open_share == pytest.approx(0.04, rel=0.02)  # 0.2 x 0.2 mm of 1 x 1 mm


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ([(0, 0), (1, 1)], "3 to 1000 corners"),
        ([(0, 0), (1e-3, math.nan), (1e-3, 0)], "finite numbers"),
        ([(0, 0), (1e-3, 1e-3), (1e-3, 0), (0, 1e-3)], "edges after corner 0 and after corner 2 cross"),
        ([(0, 0), (1e-3, 1e-3), (2e-3, 2e-3)], "with an area"),
        ([(0, 0), (1e-3, 0), (1e-3, 0), (0, 1e-3)], "corner 1 twice"),
        ("corners", "in numbers"),
        ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], r"an array of \(3, 3\)"),
    ],
)
def test_polygons_that_are_none(corners, words):
    with pytest.raises(PlanError, match=words):
        polygon_region(corners)


def test_regions_that_are_none():
    with pytest.raises(PlanError, match="two sides above 0"):
        centred_rectangle_region((0, 0), (1e-3, 0.0))
    with pytest.raises(PlanError, match="finite"):
        centred_rectangle_region((0, math.nan), (1e-3, 1e-3))
    with pytest.raises(PlanError, match="angle"):
        polygon_region(ELL, math.inf)
    with pytest.raises(PlanError, match="margin of at least 0"):
        polygon_region(ELL).inset(-1e-6)
    with pytest.raises(PlanError, match="points"):
        measure_coverage(polygon_region(ELL), np.zeros((0, 3)), np.zeros(0, dtype=int), 1e-4)


def test_a_region_from_settings():
    geometry = VolumeGeometry((11, 20, 21), (1e-4, 1e-5, 1e-4), origin_m=(1e-3, 2e-3, 0.0))
    config = RegionConfig(offset_m=(1e-4, 0.0), size_m=(4e-4, 2e-4), angle_deg=90.0)
    region = config.region(geometry)
    assert isinstance(region, Region)
    np.testing.assert_allclose(region.vertices_m.mean(axis=0), (2.1e-3, 2.5e-3))
    np.testing.assert_allclose(np.ptp(region.vertices_m, axis=0), (2e-4, 4e-4))
    polygon = RegionConfig(shape="polygon", vertices_m=tuple(ELL.ravel().tolist())).region(geometry)
    np.testing.assert_allclose(polygon.vertices_m, ELL)
    with pytest.raises(PlanError, match="got 3 numbers"):
        RegionConfig(shape="polygon", vertices_m=(0.0, 1.0, 2.0)).region(geometry)
    with pytest.raises(PlanError, match="3 to 1000 corners"):
        RegionConfig(shape="polygon").region(geometry)
    with pytest.raises(ConfigurationError, match="size_m"):
        RegionConfig(size_m=(0.0, 1e-3))
