"""The error budget: each part by hand, and their sum."""

import json

import numpy as np
import pytest
import torch

from octn_ros.errors import ConfigurationError
from octn_ros.planning import (
    Calibration,
    ErrorBudgetConfig,
    SurfaceSearchConfig,
    WaypointConfig,
    plan_raster,
    plan_to_plain,
)
from octn_ros.planning.error_budget import error_budget, local_plane_rms_m
from octn_ros.planning.plan import PlannerConfig

UP = np.tile((0.0, 0.0, 1.0), (400, 1))


def lattice(noise_m=0.0, seed=0):
    x, y = np.meshgrid(np.arange(20) * 5e-5, np.arange(20) * 5e-5)
    noise = noise_m * np.random.default_rng(seed).standard_normal(400)
    return np.column_stack([x.ravel(), y.ravel(), 1e-3 + 0.3 * x.ravel() - 0.2 * y.ravel() + noise])


def budget(calibration, config=None, waypoints=None, normals=UP, noise_m=0.0):
    points = lattice(noise_m)
    residual, slope = np.full(400, 0.01), np.full(400, 4e3)
    found = error_budget(calibration, points, residual, slope, normals, waypoints or WaypointConfig(), 3e-5, config)
    return {term.name: term for term in found.terms}, found


def test_every_part_has_a_source_and_what_nobody_stated_is_said(calibration):
    terms, found = budget(calibration)
    assert terms["calibration oct2ee"].micrometres is None
    assert "not stated" in terms["calibration oct2ee"].source
    assert found.not_stated == ("calibration oct2ee", "calibration laser2ee", "surface offset")
    assert all(term.source for term in found.terms)
    assert terms["field"].micrometres == pytest.approx(2.5)  # 0.01 / 4000 per metre
    assert terms["surface spread"].micrometres == pytest.approx(0.0, abs=1e-6)  # a plane
    assert terms["refraction, index"].micrometres == 0.0


def test_the_sum_is_the_root_of_the_squares(calibration):
    stated = Calibration(calibration.oct2ee, calibration.laser2ee, residual_rms_m={"oct2ee": 12e-6, "laser2ee": 5e-6})
    config = ErrorBudgetConfig(surface_spread_m=6e-6, surface_offset_m=4e-6, surface_source="phantoms of 2026-11")
    terms, found = budget(stated, config)
    sizes = [terms[name].micrometres for name in ("calibration oct2ee", "calibration laser2ee")]
    assert sizes == pytest.approx([12.0, 5.0])
    assert terms["surface spread"].source == terms["surface offset"].source == "phantoms of 2026-11"
    assert found.not_stated == ()
    assert found.total_um == pytest.approx(np.sqrt(12**2 + 5**2 + 2.5**2 + 6**2 + 4**2), rel=1e-6)
    json.dumps(found.to_plain(), allow_nan=False)


@pytest.mark.parametrize("seed", range(3))
def test_spread_is_estimated_from_local_planes(seed):
    assert local_plane_rms_m(lattice(5e-6, seed)) == pytest.approx(5e-6, rel=0.15)
    assert np.isnan(local_plane_rms_m(lattice()[:11]))


def test_few_waypoints_state_no_spread(calibration):
    points = lattice()[:5]
    found = error_budget(calibration, points, np.zeros(5), np.zeros(5), UP[:5], WaypointConfig(), 3e-5)
    assert {"field", "surface spread"} <= set(found.not_stated)


def test_flat_places_are_left_out_of_the_field_term_and_counted(calibration):
    residual, slope = np.full(400, 0.01), np.full(400, 4e3)
    slope[:7], slope[7:9] = 1e-6, -3.0
    found = error_budget(
        calibration, lattice(), residual, slope, UP, WaypointConfig(), 3e-5, min_slope_per_m=1e-3 / 14.59e-6
    )
    field = next(term for term in found.terms if term.name == "field")
    assert field.micrometres == pytest.approx(2.5)
    assert "without 9 of 400 waypoints" in field.source
    assert "without" not in budget(calibration)[0]["field"].source


def test_the_spread_is_that_of_the_level_set_and_not_of_the_smoothed_path(calibration, make_field):
    smooth, rough = lattice(), lattice(5e-6)
    found = error_budget(
        calibration, smooth, np.zeros(400), np.ones(400), UP, WaypointConfig(), 3e-5, roots_m=rough[:, 2]
    )
    spread = next(term for term in found.terms if term.name == "surface spread")
    assert spread.micrometres == pytest.approx(5.0, rel=0.15)

    def bumps(x, y):
        return 1e-3 + 6e-6 * (torch.sin(x / 21e-6 + 1e4 * y) + torch.sin(y / 17e-6 - 7e3 * x))

    stated = {}
    for refinement in ("newton", "least_squares"):
        config = PlannerConfig(search=SurfaceSearchConfig(refinement=refinement))
        plan = plan_raster(make_field(bumps), calibration, (3e-4, -1e-4), (8e-4, 6e-4), 0.0, config, tau=0.4)
        stated[refinement] = {term.name: term.micrometres for term in plan.error_budget.terms}["surface spread"]
        if refinement == "least_squares":
            assert local_plane_rms_m(plan.surface_m) * 1e6 < 0.9 * stated["newton"]
    assert stated["least_squares"] == pytest.approx(stated["newton"])


def test_refraction_grows_with_depth_index_and_slope(calibration):
    deep = WaypointConfig(depth_offset_m=1.38e-3, refractive_index=1.38)
    config = ErrorBudgetConfig(surface_spread_m=3e-6, refractive_index_uncertainty=0.0138)
    terms, _ = budget(calibration, config, deep)
    assert terms["refraction, index"].micrometres == pytest.approx(10.0)  # 1 mm times 1 %
    # A normal off by atan(3 / 30) turns the beam by 1 - 1 / 1.38 of it.
    flat = terms["refraction, tilt"].micrometres
    assert flat == pytest.approx(1e3 * (1 - 1 / 1.38) * np.arctan(0.1))
    steep = np.tile((np.sin(0.7), 0.0, np.cos(0.7)), (400, 1))
    assert budget(calibration, config, deep, steep)[0]["refraction, tilt"].micrometres > flat
    assert "40.1 degrees at most" in budget(calibration, config, deep, steep)[0]["refraction, tilt"].source


def test_a_calibration_that_had_to_be_mended_costs(calibration):
    bent = calibration.oct2ee.copy()
    bent[0, 0] += 5e-4
    terms, _ = budget(Calibration(bent, calibration.laser2ee))
    reach = np.linalg.norm(lattice(), axis=1).max()
    deviation = Calibration(bent, calibration.laser2ee).deviation
    assert terms["calibration rounding"].micrometres == pytest.approx(deviation * reach * 1e6)
    assert deviation > 1e-4


def test_a_plan_carries_its_budget_and_coverage(plane_field, calibration):
    config = PlannerConfig(
        waypoints=WaypointConfig(depth_offset_m=1e-4), budget=ErrorBudgetConfig(surface_offset_m=2e-6)
    )
    plan = plan_raster(plane_field, calibration, (3e-4, -1e-4), (8e-4, 6e-4), 0.0, config, tau=0.4)
    terms = {term.name: term.micrometres for term in plan.error_budget.terms}
    # The search ends within 1 % of tau, on an edge of 12 um: some tenths of a micrometre.
    assert 0.0 < terms["field"] < 0.5
    assert terms["surface spread"] < 0.5
    assert terms["surface offset"] == pytest.approx(2.0)
    assert terms["refraction, index"] == pytest.approx(100 / 1.38 * 0.02 / 1.38)
    plain = json.loads(json.dumps(plan_to_plain(plan), allow_nan=False))
    assert plain["error_budget"]["total_um"] == pytest.approx(plan.error_budget.total_um)
    assert plain["coverage"]["line_gap_m"] <= 50e-6 * 1.0001
    assert plain["coverage"]["surface_point_gap_m"] <= 50e-6 * 1.01


def test_settings_are_checked():
    with pytest.raises(ConfigurationError, match="surface_spread_m"):
        ErrorBudgetConfig(surface_spread_m=-1e-6)
