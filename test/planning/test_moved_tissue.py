"""The tissue turned and shifted under the probe gives the turned and shifted plan; the same scan, the same plan."""

import math

import numpy as np
import pytest

from octn_ros.field import InterpolatedField
from octn_ros.planning import PlannerConfig, RasterConfig, WaypointConfig, centred_rectangle_region, plan_region
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import gaussian_filter

SPREAD_M = 7.3e-6  # half an axial voxel
SCAN = {"shape": (48, 128, 96), "spacing_m": (28e-6, 14.59e-6, 14e-6), "surface_depth_m": 5e-4}
SIZE_M = (5e-4, 4e-4)
CONFIG = PlannerConfig(
    raster=RasterConfig(point_spacing_along="lateral"), waypoints=WaypointConfig(orientation="normal")
)


def plan_on(calibration, centre, angle, **tissue):
    phantom = make_phantom(PhantomConfig(**SCAN, **tissue))
    field = InterpolatedField(gaussian_filter(phantom.volume, 1.0))
    region = centred_rectangle_region(centre, SIZE_M, angle)
    return plan_region(field, calibration, region, CONFIG), phantom


def middle(phantom):
    return 0.5 * np.array(phantom.volume.geometry.extent_m[:2])


@pytest.mark.parametrize(
    ("surface", "degrees", "shift"),
    [
        ("tilted", 40.0, (6e-5, -5e-5, 7.3e-5)),
        ("wavy", 90.0, (0.0, 0.0, 3.1e-5)),
        ("wavy", -25.0, (-4e-5, 8e-5, -4e-5)),
        ("rough", 140.0, (5e-5, 5e-5, 0.0)),
    ],
)
def test_turned_and_shifted_tissue_gives_the_turned_and_shifted_plan(calibration, surface, degrees, shift):
    tissue = {"surface": surface, "tilt_deg": 8.0, "wave_period_m": 8e-4, "wave_amplitude_m": 4e-5, "seed": 3}
    scan_middle = 0.5 * np.array([95 * 14e-6, 47 * 28e-6])
    angle = math.radians(degrees)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    here, phantom = plan_on(calibration, scan_middle, 0.0, **tissue)
    assert middle(phantom) == pytest.approx(scan_middle)
    there, moved = plan_on(calibration, scan_middle + shift[:2], angle, **tissue, rotation_deg=degrees, shift_m=shift)
    # Other grains of speckle lie under the waypoints, so each plan may give up others of the same places.
    assert here.requested == there.requested
    assert max(here.given_up, there.given_up) <= 0.02 * here.requested

    expected = np.column_stack(
        [(here.surface_m[:, :2] - scan_middle) @ turn.T + scan_middle + shift[:2], here.surface_m[:, 2] + shift[2]]
    )
    pairs = matches(expected[:, :2], there.surface_m[:, :2])
    assert len(pairs) >= 0.96 * here.requested
    difference = there.surface_m[pairs[:, 1], 2] - expected[pairs[:, 0], 2]
    assert np.std(difference) < math.sqrt(2) * SPREAD_M
    assert abs(np.median(difference)) < SPREAD_M
    # The truths are turned and shifted alike, so this is no agreement in error.
    for plan, truth in ((here, phantom), (there, moved)):
        depth = plan.surface_m[:, 2] - truth.surface_depth_m(*plan.surface_m[:, :2].T)
        assert np.std(depth) < SPREAD_M
    # So are the normals, on average over the raster.
    z_here, z_there = (plan.waypoints_oct[:, :3, 2].mean(axis=0) for plan in (here, there))
    np.testing.assert_allclose(z_there[:2], turn @ z_here[:2], atol=0.03)


def matches(first, second):
    """Pairs of places that are the same within a nanometre, as (index of first, index of second)."""
    distance = np.linalg.norm(first[:, None] - second[None], axis=-1)
    return np.argwhere(distance < 1e-9)


def test_planning_twice_gives_the_same_path(calibration):
    plans = [plan_on(calibration, (6.5e-4, 6.5e-4), 0.4, surface="wavy", seed=5)[0] for _ in range(2)]
    for name in ("waypoints_ee", "waypoints_oct", "surface_m", "segment", "residual", "confidence"):
        np.testing.assert_array_equal(getattr(plans[0], name), getattr(plans[1], name))
    assert plans[0].coverage == plans[1].coverage
    assert plans[0].error_budget == plans[1].error_budget
