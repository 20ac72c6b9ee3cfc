import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from octn_ros.errors import ConfigurationError, OctnError, PlanError
from octn_ros.field import InterpolatedField
from octn_ros.metrics import surface_distance
from octn_ros.planning import (
    Calibration,
    EnvelopeConfig,
    PlannerConfig,
    RasterConfig,
    SurfaceSearchConfig,
    WaypointConfig,
    plan_raster,
    plan_to_plain,
    quaternions_xyzw,
)
from octn_ros.planning.trust import TrustConfig
from octn_ros.settings import as_plain, from_plain
from octn_ros.simulation import PhantomConfig, make_phantom

CORNER, OPPOSITE = (3e-4, -1e-4), (8e-4, 6e-4)
LATERAL = PlannerConfig(
    raster=RasterConfig(point_spacing_along="lateral"),
    # The walls of the crater bend more within a neighbourhood than speckled tissue may.
    search=SurfaceSearchConfig(trust=TrustConfig(max_scatter_m=146e-6)),
)


def test_a_plan_on_a_known_surface(any_field, calibration):
    plan = plan_raster(any_field, calibration, CORNER, OPPOSITE, 0.0, LATERAL, tau=0.4, field_hash="abc")
    assert (plan.requested, plan.given_up, len(plan.given_up_points)) == (11 * 15, 0, 0)
    assert plan.hit_rate == 1.0
    assert surface_distance(plan.surface_m, any_field.depth).rms_um < 1.0
    np.testing.assert_allclose(plan.waypoints_oct[:, :3, 3], plan.surface_m)
    np.testing.assert_allclose(plan.waypoints_ee, calibration.oct2ee @ plan.waypoints_oct)
    np.testing.assert_allclose(plan.surface_m[0, :2], CORNER)
    np.testing.assert_allclose(plan.surface_m[-1, :2], OPPOSITE)
    assert plan.segment.tolist() == np.repeat(np.arange(15), 11).tolist()
    assert plan.laser_on.all()
    assert (plan.speed_m_s == 5e-3).all()
    assert (plan.field_hash, plan.field_kind, plan.stamp_ns) == ("abc", "neural", 42)
    assert (plan.oct_frame, plan.ee_frame) == ("oct_optical_frame", "tool0")
    assert plan.seconds["total"] >= plan.seconds["coarse"] > 0


def test_tau_is_estimated_when_nobody_tells_it(plane_field, calibration):
    assert plan_raster(plane_field, calibration, CORNER, OPPOSITE).tau == pytest.approx(0.4, abs=0.02)
    assert plan_raster(plane_field, calibration, CORNER, OPPOSITE, config=PlannerConfig(tau=0.35)).tau == 0.35


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angle=st.floats(-4.0, 4.0), width=st.floats(1e-4, 4e-4), height=st.floats(1e-4, 4e-4), normal=st.booleans())
def test_any_rectangle_is_covered_by_rigid_poses_and_the_same_each_time(
    plane_field, calibration, angle, width, height, normal
):
    first, second = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    middle, half = np.array([5.4e-4, 3.4e-4]), (width * first + height * second) / 2
    config = PlannerConfig(waypoints=WaypointConfig(orientation="normal" if normal else "beam", standoff_m=1e-4))
    plans = [plan_raster(plane_field, calibration, middle - half, middle + half, angle, config) for _ in range(2)]
    np.testing.assert_array_equal(plans[0].waypoints_ee, plans[1].waypoints_ee)
    np.testing.assert_array_equal(plans[0].segment, plans[1].segment)
    plan = plans[0]
    assert plan.given_up == 0
    lines = np.split(plan.surface_m[:, :2], np.flatnonzero(np.diff(plan.segment)) + 1)
    offsets = np.array([np.mean((line - middle) @ second) for line in lines])
    assert np.abs(np.diff(offsets)).max() <= 50e-6 * (1 + 1e-6)
    np.testing.assert_allclose(np.abs(offsets[[0, -1]]), height / 2, atol=1e-9)
    for poses in (plan.waypoints_oct, plan.waypoints_ee):
        rotation = poses[:, :3, :3]
        np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (len(poses), 1, 1)),
                                   atol=1e-9)  # fmt: skip
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
        np.testing.assert_allclose(np.linalg.norm(quaternions_xyzw(poses), axis=1), 1.0)
    assert (plan.waypoints_oct[:, 2, 2] > 0).all()
    shift = plan.surface_m - plan.waypoints_oct[:, :3, 3]
    np.testing.assert_allclose(shift, 1e-4 * plan.waypoints_oct[:, :3, 2], atol=1e-12)


def field_with_hole(make_field):
    def hole(points):  # no tissue in a strip of 100 um across the lines
        x, _, z = field.geometry.canonical_to_metric(points.double()).unbind(-1)
        return -0.6 * torch.sigmoid((z - 1e-3) / 12e-6) * ((x > 4.8e-4) & (x < 5.8e-4))

    field = make_field(lambda x, y: 1e-3 + 0 * x)
    field.noise = hole
    return field


def test_a_gap_of_given_up_waypoints_breaks_the_segment(make_field, calibration):
    plan = plan_raster(field_with_hole(make_field), calibration, CORNER, OPPOSITE, tau=0.4)
    assert plan.given_up == 2 * 15  # x = 0.50 and 0.55 mm in each line
    assert plan.requested == 11 * 15 == plan.given_up + len(plan.segment)
    assert plan.segment.max() == 29
    assert (np.bincount(plan.segment)[:2] == (4, 5)).all()
    assert plan.hit_rate == pytest.approx(9 / 11)
    point = plan.given_up_points[0]
    assert (point.x_m, point.y_m) == (pytest.approx(5e-4), pytest.approx(-1e-4))
    assert "does not rise through tau" in point.reason


def test_too_many_given_up_waypoints_refuse_the_plan(make_field, calibration):
    config = dataclasses.replace(LATERAL, envelope=EnvelopeConfig(max_given_up=0.1))
    with pytest.raises(
        PlanError, match=r"at most 10% .*got 30 of 165 \(18%\), 30 of them because .*\(0\.500, -0\.100\)"
    ):
        plan_raster(field_with_hole(make_field), calibration, CORNER, OPPOSITE, 0.0, config, tau=0.4)
    with pytest.raises(PlanError, match=r"got 165 of 165 \(100%\)"):
        plan_raster(make_field(lambda x, y: 1e-3 + 0 * x), calibration, CORNER, OPPOSITE, 0.0,
                    PlannerConfig(envelope=EnvelopeConfig(max_given_up=1.0)), tau=0.95)  # fmt: skip


@pytest.mark.parametrize(
    ("corner", "opposite", "angle", "words"),
    [
        ((5e-5, 0.0), OPPOSITE, 0.0, r"raster corner 0 at \(0\.050, 0\.000\) mm"),
        (CORNER, (5e-3, 6e-4), 0.0, r"x from 0\.100 to 0\.982 mm"),
        ((1.2e-4, -1.9e-4), (9.7e-4, 8.8e-4), 0.4, "raster corner"),  # the other two corners stick out
        ((math.nan, 0.0), OPPOSITE, 0.0, "finite numbers"),
        (CORNER, (math.inf, 6e-4), 0.0, "finite numbers"),
        (CORNER, OPPOSITE, math.nan, "finite numbers"),
        (CORNER, CORNER, 0.0, "two sides"),
    ],
)
def test_rectangles_that_cannot_be_planned(plane_field, calibration, corner, opposite, angle, words):
    with pytest.raises(PlanError, match=words):
        plan_raster(plane_field, calibration, corner, opposite, angle)


def test_a_line_spacing_of_more_than_a_million_waypoints(plane_field, calibration):
    config = PlannerConfig(raster=RasterConfig(line_spacing_m=1e-7, point_spacing_m=1e-6))
    with pytest.raises(PlanError, match=r"at most 1,000,000 waypoints, got 7001 lines of 501"):
        plan_raster(plane_field, calibration, CORNER, OPPOSITE, 0.0, config)


def test_a_calibration_of_another_frame(plane_field, calibration):
    other = Calibration(calibration.oct2ee, calibration.laser2ee, oct_frame="other_probe")
    with pytest.raises(PlanError, match="expected a field in the calibrated frame 'other_probe'"):
        plan_raster(plane_field, other, CORNER, OPPOSITE)


def test_a_field_without_surface(make_field, calibration):
    field = make_field(lambda x, y: 1e-3 + 0 * x)
    field.evaluate = lambda points: 0.5 + 0.0 * points.sum(dim=-1)
    with pytest.raises(OctnError, match="no surface to plan on"):
        plan_raster(field, calibration, CORNER, OPPOSITE)


def test_a_moved_scan_gives_the_moved_plan(make_field, calibration):
    # The same voxels under another origin: the path moves with it, exactly in the OCT frame.
    shift = np.array([2e-3, -1e-3, 5e-4])
    still = make_field(lambda x, y: 1.05e-3 + 0.2 * x - 0.1 * y)
    moved = make_field(lambda x, y: 1.05e-3 + 0.2 * (x - shift[0]) - 0.1 * (y - shift[1]) + shift[2])
    geometry = still.geometry
    moved.geometry = dataclasses.replace(geometry, origin_m=tuple(np.array(geometry.origin_m) + shift))
    here = plan_raster(still, calibration, CORNER, OPPOSITE, tau=0.4)
    there = plan_raster(moved, calibration, CORNER + shift[:2], OPPOSITE + shift[:2], tau=0.4)
    np.testing.assert_allclose(there.surface_m, here.surface_m + shift, atol=0.5e-6)


def test_json_holds_a_plan(make_field, calibration):
    plan = plan_raster(field_with_hole(make_field), calibration, CORNER, OPPOSITE, tau=0.4)
    plain = json.loads(json.dumps(plan_to_plain(plan), allow_nan=False))
    assert plain["frame"] == "tool0"
    assert plain["given_up"] == len(plain["given_up_points"]) == 30
    lengths = {len(values) for values in plain["waypoints"].values()}
    assert lengths == {135}
    assert plain["config"]["search"]["coarse"]["max_ascans"] == 1024


def test_configuration_survives_json():
    config = PlannerConfig(raster=RasterConfig(4e-5, 6e-5), search=SurfaceSearchConfig(newton_steps=3))
    assert from_plain(PlannerConfig, json.loads(json.dumps(as_plain(config)))) == config
    with pytest.raises(ConfigurationError, match="speed_m_s"):
        PlannerConfig(speed_m_s=0.0)


@pytest.mark.parametrize("speckle", ["averaged", "single-look"])
def test_a_speckled_phantom_is_planned_within_the_issue_figures(calibration, speckle):
    phantom = make_phantom(PhantomConfig(shape=(40, 160, 96), speckle=speckle, surface="wavy"))
    field = InterpolatedField(phantom.volume)
    plan = plan_raster(field, calibration, (1e-4, 1e-4), (1.2e-3, 1e-3), 0.0)
    assert plan.hit_rate > 0.95
    assert plan.given_up <= 0.05 * plan.requested
    assert surface_distance(plan.surface_m, phantom.surface_depth_m).rms_um < 30.0
