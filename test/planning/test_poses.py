"""Waypoints off the surface and askew: tilt limit, standoff, refraction, leads, and quaternions along a path."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from octn_ros.errors import ConfigurationError, PlanError
from octn_ros.planning import (
    PlannerConfig,
    RasterConfig,
    SurfaceSearchConfig,
    WaypointConfig,
    place_waypoints,
    plan_raster,
    plan_to_plain,
    quaternions_xyzw,
    rectangle_raster,
)
from octn_ros.planning.path import path_through
from octn_ros.planning.trust import TrustConfig
from octn_ros.planning.waypoints import limit_tilt, refract
from octn_ros.simulation import Arm, ArmConfig, LaserPath

CORNER, OPPOSITE = (3e-4, -1e-4), (8e-4, 6e-4)
TRUSTING = SurfaceSearchConfig(trust=TrustConfig(max_scatter_m=146e-6))
BEAM = np.array([0.0, 0.0, 1.0])


def tilted(degrees, azimuth=0.0):
    angle = np.radians(degrees)
    return np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])


@given(st.floats(0.0, 89.0), st.floats(-4.0, 4.0), st.floats(0.0, 89.0))
def test_tilt_is_limited_in_its_own_azimuth(degrees, azimuth, limit):
    axis = tilted(degrees, azimuth)
    (z,), (limited,) = limit_tilt(axis[None], np.radians(limit))
    assert np.linalg.norm(z) == pytest.approx(1.0)
    assert np.degrees(np.arctan2(np.hypot(*z[:2]), z[2])) == pytest.approx(min(degrees, limit), abs=1e-6)
    assert limited == (degrees > limit + 1e-6) or abs(degrees - limit) < 1e-5
    assert abs(z[0] * axis[1] - z[1] * axis[0]) < 1e-9
    if not limited:
        np.testing.assert_array_equal(z, axis)


@given(st.floats(0.0, 89.0), st.floats(-4.0, 4.0), st.floats(1.0, 3.0))
def test_snells_law(degrees, azimuth, index):
    normal = tilted(degrees, azimuth)
    (inside,) = refract(BEAM, normal[None], index)
    assert np.linalg.norm(inside) == pytest.approx(1.0)
    assert np.linalg.norm(np.cross(inside, normal)) == pytest.approx(np.sin(np.radians(degrees)) / index, abs=1e-9)
    assert abs(np.dot(inside, np.cross(BEAM, normal))) < 1e-9  # in the plane of incidence
    assert np.dot(inside, normal) > 0


def sloped(make_field, degrees):
    slope = np.tan(np.radians(degrees))
    return make_field(lambda x, y: 1.0e-3 + slope * (x - 5e-4) + 0 * y)


POINTS = np.array([[5e-4, 1e-4, 1.0e-3], [5.5e-4, 3e-4, 1.0e-3 + 5e-5 * np.tan(np.radians(30))]])


def test_beyond_the_limit_a_waypoint_is_tilted_to_it_and_flagged_or_refused(make_field):
    field = sloped(make_field, 30.0)
    free = place_waypoints(field, POINTS, WaypointConfig(orientation="normal"))
    np.testing.assert_allclose(free.poses_oct[:, :3, 2], np.tile(tilted(30.0, np.pi), (2, 1)), atol=1e-3)
    assert not free.tilt_limited.any()
    limited = place_waypoints(field, POINTS, WaypointConfig(orientation="normal", max_tilt_deg=20.0))
    np.testing.assert_allclose(limited.poses_oct[:, :3, 2], np.tile(tilted(20.0, np.pi), (2, 1)), atol=1e-3)
    assert limited.tilt_limited.all()
    refuse = WaypointConfig(orientation="normal", max_tilt_deg=20.0, beyond_tilt="refuse")
    with pytest.raises(PlanError, match=r"at most 20 degrees .* 2 of 2 .*waypoint 0 at \(0\.500, 0\.100\) mm needs 30"):
        place_waypoints(field, POINTS, refuse)
    beam = place_waypoints(field, POINTS, WaypointConfig(max_tilt_deg=20.0, beyond_tilt="refuse"))
    assert not beam.tilt_limited.any()


@pytest.mark.parametrize(
    ("config", "towards_probe"),
    [
        ({"standoff_along": "beam"}, BEAM),
        ({"standoff_along": "normal"}, tilted(30.0, np.pi)),
        ({"standoff_along": "pose"}, BEAM),
        ({"standoff_along": "pose", "orientation": "normal"}, tilted(30.0, np.pi)),
        ({"standoff_along": "pose", "orientation": "normal", "max_tilt_deg": 10.0}, tilted(10.0, np.pi)),
        ({"standoff_along": "beam", "orientation": "normal"}, BEAM),
    ],
)
def test_standoff_along_beam_normal_or_pose(make_field, config, towards_probe):
    found = place_waypoints(sloped(make_field, 30.0), POINTS, WaypointConfig(standoff_m=2e-4, **config))
    np.testing.assert_allclose(found.poses_oct[:, :3, 3], POINTS - 2e-4 * towards_probe, atol=4e-7)


def test_an_optical_depth_is_divided_by_the_index_along_the_refracted_beam(make_field):
    config = WaypointConfig(depth_offset_m=2.76e-4, refractive_index=1.38)
    flat = place_waypoints(sloped(make_field, 0.0), POINTS, config)
    np.testing.assert_allclose(flat.poses_oct[:, :3, 3], POINTS + np.array([0.0, 0.0, 2e-4]), atol=1e-9)
    steep = place_waypoints(sloped(make_field, 30.0), POINTS, config)
    # Incidence 30 degrees, 21.24 inside: the beam is bent by 8.76 degrees towards the normal, so towards -x.
    bent = np.radians(30.0) - np.arcsin(np.sin(np.radians(30.0)) / 1.38)
    expected = POINTS + 2e-4 * np.array([-np.sin(bent), 0.0, np.cos(bent)])
    np.testing.assert_allclose(steep.poses_oct[:, :3, 3], expected, atol=4e-7)
    np.testing.assert_array_equal(steep.poses_oct[:, :3, 2], np.tile(BEAM, (2, 1)))


def test_standoff_and_depth_offset_exclude_each_other():
    with pytest.raises(ConfigurationError, match="a standoff or a depth offset, got both"):
        WaypointConfig(standoff_m=1e-4, depth_offset_m=1e-4)


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angle=st.floats(-4.0, 4.0), limit=st.floats(1.0, 60.0), standoff=st.floats(-1e-4, 1e-4))
def test_any_plan_has_unit_quaternions_that_never_flip_and_z_into_the_tissue(
    make_field, calibration, angle, limit, standoff
):
    field = make_field(lambda x, y: 1.0e-3 + 8e-5 * torch.sin(x / 8e-5) + 0.2 * y)
    half = 1.5e-4 * np.array([np.cos(angle) - np.sin(angle), np.sin(angle) + np.cos(angle)])
    middle = np.array([5.4e-4, 3.4e-4])
    config = PlannerConfig(
        search=TRUSTING,
        waypoints=WaypointConfig(orientation="normal", max_tilt_deg=limit, standoff_m=standoff),
    )
    plan = plan_raster(field, calibration, middle - half, middle + half, angle, config, tau=0.4)
    for poses in (plan.waypoints_oct, plan.waypoints_ee):
        quaternions = quaternions_xyzw(poses)
        np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0)
        assert (np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0).all()
    z = plan.waypoints_oct[:, :3, 2]
    assert (z[:, 2] > 0).all()
    tilt = np.degrees(np.arctan2(np.hypot(z[:, 0], z[:, 1]), z[:, 2]))
    assert tilt.max() <= limit + 1e-6
    np.testing.assert_allclose(tilt[plan.tilt_limited], limit, atol=1e-6)
    np.testing.assert_allclose(plan.waypoints_oct[:, :3, 3], plan.surface_m - standoff * z, atol=1e-12)


def test_leads_lie_on_the_line_before_and_after_it():
    pattern = rectangle_raster((0.0, 0.0), (3e-4, 1e-4), 0.0, RasterConfig(1e-4, 1e-4))
    config = RasterConfig(lead_in_m=5e-5, lead_out_m=2e-5)
    # The first point of the second line, which runs back, is given up, and the second of the first line.
    kept = np.array([0, 2, 3, 5, 6, 7])
    path = path_through(pattern, kept, np.array([1.0, 0.0]), config)
    x = pattern.points_m[kept[path.source], 0] + path.shift_m[:, 0]
    np.testing.assert_allclose(x, [-5e-5, 0, 2e-4, 3e-4, 3.2e-4, 2.5e-4, 2e-4, 1e-4, 0, -2e-5], atol=1e-12)
    assert path.laser_on.tolist() == [False, True, True, True, False, False, True, True, True, False]
    assert path.segment.tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 2, 2]
    assert (path.shift_m[:, 1] == 0).all()


def test_a_lead_of_a_line_of_one_point_follows_the_region():
    pattern = dataclasses.replace(rectangle_raster((0, 0), (1e-4, 1e-4)), points_m=np.zeros((1, 2)),
                                  segment=np.zeros(1, np.int32))  # fmt: skip
    path = path_through(pattern, np.array([0]), np.array([0.0, 1.0]), RasterConfig(lead_in_m=1e-5))
    np.testing.assert_allclose(path.shift_m, [(0.0, -1e-5), (0.0, 0.0)])


def leading(lead=5e-5):
    raster = RasterConfig(1e-4, 1e-4, lead_in_m=lead, lead_out_m=lead)
    return PlannerConfig(raster=raster)


def test_leads_in_a_plan_fire_nothing_in_the_simulated_arm(plane_field, calibration):
    plan = plan_raster(plane_field, calibration, CORNER, OPPOSITE, 0.0, leading(), tau=0.4)
    lines = plan.segment[-1] + 1
    assert int((~plan.laser_on).sum()) == 2 * lines
    assert np.isnan(plan.residual[~plan.laser_on]).all()
    assert np.isfinite(plan.residual[plan.laser_on]).all()
    bare = plan_raster(plane_field, calibration, CORNER, OPPOSITE, 0.0, leading(0.0), tau=0.4)
    np.testing.assert_array_equal(plan.waypoints_ee[plan.laser_on], bare.waypoints_ee)
    assert plan.smoothness_mm2 == bare.smoothness_mm2
    assert plan.coverage == bare.coverage
    json.dumps(plan_to_plain(plan), allow_nan=False)

    arm = Arm(ArmConfig(reach_m=10.0), calibration.laser2ee, np.eye(4))
    arm.stage(LaserPath(plan.waypoints_ee, plan.segment, plan.laser_on, plan.speed_m_s, 42, "tool0"), 42, np.eye(4))
    arm.execute(42, dwell_s=1e-3)
    shots = []
    while arm.state == "executing":
        shots += arm.step(1e-3)
    assert arm.executed == plan.laser_on.sum()
    assert [shot.waypoint for shot in shots] == np.flatnonzero(plan.laser_on).tolist()
    fired = plan.waypoints_ee[plan.laser_on]
    np.testing.assert_allclose([shot.planned2base for shot in shots], fired, atol=1e-12)


def test_a_lead_out_of_the_scan_refuses_the_plan(plane_field, calibration):
    with pytest.raises(PlanError, match=r"outside the scanned field.*waypoint 0 at"):
        plan_raster(plane_field, calibration, CORNER, OPPOSITE, 0.0, leading(3e-4), tau=0.4)
