"""The closed loop: how it decides, and a run of it over the graph on a small phantom; the full one is slow."""

import itertools
import json
import re

import numpy as np
import pytest

from octn_ros.cli import main
from octn_ros.demo.ablation_request import AblationRequest, PassReport, Planning, next_pass
from octn_ros.demo.closed_loop_result import shots_outside_m
from octn_ros.errors import ConfigurationError
from octn_ros.query import SurfaceMap
from octn_ros.simulation import LaserConfig

SIDE = ((1e-3, 2e-3), (2e-3, 3e-3))


def report(planning, measured_m):
    return PassReport(planning, measured_m, 100, 0, 100, 1.0, 2.0)


def test_the_first_pass_goes_by_the_laser_as_it_is_taken_to_be():
    request = AblationRequest(0.3e-3, SIDE, LaserConfig())
    first = next_pass(request, [])
    assert first.depth_m == pytest.approx(100e-6)
    assert request.laser.raster_depth_m(first.dwell_s, 75e-6, 75e-6) == pytest.approx(first.depth_m)


@pytest.mark.parametrize("true_over_assumed", [0.5, 0.8, 1.0, 1.5])
def test_passes_adapt_until_the_depth_is_reached(true_over_assumed):
    request = AblationRequest(0.3e-3, SIDE)
    gone, passes = 0.0, []
    while (planning := next_pass(request, passes)) is not None:
        assert 0 < planning.depth_m <= request.largest_pass_m * (1 + 1e-9)
        gone += true_over_assumed * request.laser.raster_depth_m(planning.dwell_s, 75e-6, 75e-6)
        passes.append(report(planning, gone))
    assert abs(gone - request.depth_m) <= request.tolerance_m
    # The first pass takes as much as it does; from the second on the laser is known.
    for before, after in itertools.pairwise(passes):
        assert after.measured_depth_m - before.measured_depth_m == pytest.approx(after.planning.depth_m)


def test_a_laser_that_does_nothing_is_given_up_after_the_last_pass():
    request, passes = AblationRequest(0.3e-3, SIDE, most_passes=3), []
    while (planning := next_pass(request, passes)) is not None:
        passes.append(report(planning, 0.0))
    assert len(passes) == 3


def test_too_deep_is_not_fired_at_again():
    request = AblationRequest(0.1e-3, SIDE)
    assert next_pass(request, [report(Planning(100e-6, 5e-3), 0.12e-3)]) is None


def test_the_measured_depth_is_the_median_inside_the_band():
    request = AblationRequest(0.1e-3, SIDE)
    x, y = np.linspace(0.0, 3e-3, 61), np.linspace(0.0, 4e-3, 81)
    band = request.laser.spot_radius_m
    inside = request.inside(x, y, band)
    assert inside.sum() == np.sum((x > 1e-3 + band) & (x < 2e-3 - band)) * np.sum((y > 2e-3 + band) & (y < 3e-3 - band))
    whole, gone = np.full((81, 61), 0.5e-3), np.where(inside, 80e-6, -1.0)
    maps = [SurfaceMap(depth, None, None, x, y) for depth in (whole, whole + gone)]
    assert request.measured_depth_m(*maps) == pytest.approx(80e-6)


@pytest.mark.parametrize(
    ("depth_m", "corners_m", "message"),
    [
        (0.0, SIDE, "above 0 um"),
        (float("nan"), SIDE, "above 0 um"),
        (1e-4, ((0.0, 0.0), (1e-3, 1e-4)), "1000 x 100 um"),
    ],
)
def test_impossible_requests_are_refused(depth_m, corners_m, message):
    with pytest.raises(ConfigurationError, match=message):
        AblationRequest(depth_m, corners_m)


def test_shots_outside_are_told_from_the_audit_record(tmp_path):
    places = [(1.5e-3, 2.5e-3), (0.9e-3, 2.5e-3), (2.3e-3, 3.4e-3)]
    lines = [{"event": "execute"}, *({"event": "shot", "actual_m": [*place, 0.0]} for place in places)]
    (tmp_path / "audit.jsonl").write_text("\n".join(json.dumps(line) for line in lines))
    outside = shots_outside_m(AblationRequest(1e-4, SIDE), tmp_path / "audit.jsonl")
    np.testing.assert_allclose(outside, [0.0, 1e-4, 5e-4], atol=1e-12)


def run(tmp_path, capsys, *arguments):
    assert main(["demo", "--closed-loop", "--json", "--output", str(tmp_path), *arguments]) == 0
    values = json.loads(capsys.readouterr().out)
    lines = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert [line["event"] for line in lines if line["event"] != "shot"] == ["execute", "end"] * len(values["passes"])
    for line in lines:
        if line["event"] == "execute":
            assert line["operator"] == "octn demo --closed-loop"
            assert line["planner"] == "planner"
            assert all(re.fullmatch("[0-9a-f]{16,}", line[name]) for name in ("scan_hash", "field_hash", "plan_hash"))
    assert sum(line["event"] == "shot" for line in lines) == values["shots"] > 0
    assert (tmp_path / "closed_loop.html").read_text().count("data:image/png;base64,") == 3
    return values


def test_a_small_phantom_is_ablated_to_the_depth_asked_for(tmp_path, capsys):
    values = run(tmp_path, capsys, "--quick", "--depth-um", "120")
    assert values["requested_um"] == pytest.approx(120)
    # The tissue takes a fifth more energy than the loop is told, so that one pass of 100 um at most cannot do.
    assert 2 <= len(values["passes"]) <= 4
    assert values["rms_error_um"] < 30
    assert values["field_rms_error_um"] < 40
    assert values["shots_outside"] == 0
    assert values["removed_mm3"] == pytest.approx(values["requested_mm3"], rel=0.25)
    assert all(0 < done["spot_error_rms_um"] < 40 for done in values["passes"])


@pytest.mark.slow
@pytest.mark.timeout(900)  # four minutes beside two other suites
def test_the_wavy_phantom_is_ablated_to_300_um_over_3_by_3_mm(tmp_path, capsys):
    values = run(tmp_path, capsys)
    x0, y0, x1, y1 = values["rectangle_mm"]
    assert (values["requested_um"], x1 - x0, y1 - y0) == pytest.approx((300, 3, 3))
    assert values["rms_error_um"] < 60
    assert values["shots_outside"] == 0
    assert values["removed_mm3"] == pytest.approx(values["requested_mm3"], rel=0.1)


def test_options_that_do_not_fit_are_refused_in_one_line(tmp_path, capsys):
    for arguments in (
        ["--depth-um", "100"],
        ["--closed-loop", "--volume", "scan.nii"],
        ["--closed-loop", "--quick", "--depth-um", "-5"],
    ):
        assert main(["demo", "--output", str(tmp_path), *arguments]) == 2
        errors = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
        assert len(errors) == 1
        assert errors[0].startswith("octn demo: error: ")
