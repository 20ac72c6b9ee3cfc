"""The safety envelope: each limit refuses with the waypoint, the place and the reason."""

import dataclasses

import numpy as np
import pytest
import yaml

from octn_ros.errors import ConfigurationError, PlanError
from octn_ros.planning import EnvelopeConfig, KeepOut, PlannerConfig, load_keep_out, plan_raster
from octn_ros.planning.envelope import PathToCheck, check_envelope, find_violations
from octn_ros.planning.transforms import from_translation_quaternion, invert
from octn_ros.volume import VolumeGeometry

GEOMETRY = VolumeGeometry((11, 101, 11), (1e-4, 1e-5, 1e-4))
CORNER, OPPOSITE = (3e-4, -1e-4), (8e-4, 6e-4)
EE2BASE = from_translation_quaternion((0.4, 0.1, 0.3), (1.0, 0.0, 0.0, 0.0))


def line_path(z, **changes):
    """Five waypoints along x at 0.1 mm, at these depths."""
    z = np.broadcast_to(z, 5)
    surface = np.column_stack([np.linspace(2e-4, 6e-4, 5), np.full(5, 5e-4), z])
    path = PathToCheck(surface, surface, np.zeros(5, np.int32), np.ones(5, bool), np.full(5, 0.9))
    return dataclasses.replace(path, **changes)


def box(low, high, frame="oct"):
    return KeepOut("vessel", frame, "box", np.array([low, high]))


def test_a_path_inside_is_left_alone():
    config = EnvelopeConfig(min_confidence=0.5, max_depth_m=6e-4, max_step_m=5e-5, max_slope_deg=20.0)
    check_envelope(line_path([5e-4, 5.1e-4, 5.3e-4, 5.2e-4, 5e-4]), GEOMETRY, config)


@pytest.mark.parametrize(
    ("config", "z", "words"),
    [
        ({"max_depth_m": 5e-4}, [4e-4, 4e-4, 5.5e-4, 4e-4, 4e-4],
         r"waypoint 2 at \(0\.400, 0\.500, 0\.550\) mm: 0\.550 mm, deeper than 0\.500 mm"),
        ({"max_step_m": 5e-5}, [4e-4, 4e-4, 4e-4, 4.6e-4, 4.6e-4], "waypoint 3 .* a step of 60.0 um"),
        ({"max_slope_deg": 30.0}, [4e-4, 5e-4, 5e-4, 5e-4, 5e-4], "waypoint 1 .* a slope of 45.0 degrees"),
        ({"min_confidence": 0.95}, 5e-4, r"5 of low confidence.*waypoint 0 .* confidence 0\.900.*and 2 more"),
        ({}, [4e-4, 4e-4, 4e-4, 4e-4, 1.2e-3], r"outside the scanned field.*waypoint 4 .*z 0\.000 to 1\.000 mm"),
        ({}, [4e-4, np.nan, 4e-4, 4e-4, 4e-4], "waypoint 1 .*outside the scanned field"),
    ],
)  # fmt: skip
def test_each_limit_names_the_waypoint_and_the_reason(config, z, words):
    with pytest.raises(PlanError, match=words):
        check_envelope(line_path(z), GEOMETRY, EnvelopeConfig(**config))


def test_limits_between_neighbours_do_not_reach_over_turns_and_leads():
    steps = [4e-4, 4e-4, 4e-4, 9e-4, 9e-4]
    strict = EnvelopeConfig(max_step_m=5e-5, max_slope_deg=30.0)
    assert len(find_violations(line_path(steps), GEOMETRY, strict)) == 2
    assert not find_violations(line_path(steps, segment=np.array([0, 0, 0, 1, 1])), GEOMETRY, strict)
    assert not find_violations(line_path(steps, laser_on=np.array([True] * 3 + [False] * 2)), GEOMETRY, strict)


def test_a_standoff_may_lift_the_focus_out_of_the_scan_but_not_sideways():
    path = line_path(5e-4)
    check_envelope(dataclasses.replace(path, focus_m=path.focus_m - (0, 0, 5e-3)), GEOMETRY, EnvelopeConfig())
    for shift in ((5e-3, 0, 0), (0, -5e-3, 0), (0, 0, 6e-4)):
        with pytest.raises(PlanError, match="outside the scanned field"):
            check_envelope(dataclasses.replace(path, focus_m=path.focus_m + shift), GEOMETRY, EnvelopeConfig())


@pytest.mark.parametrize("frame", ["oct", "ee", "base"])
def test_keep_out_boxes_and_polygons_in_every_frame(calibration, frame):
    # Around the third waypoint in the OCT frame, given in another one.
    oct2frame = {"oct": np.eye(4), "ee": calibration.oct2ee, "base": EE2BASE @ calibration.oct2ee}[frame]
    centre = oct2frame[:3, :3] @ (4e-4, 5e-4, 5e-4) + oct2frame[:3, 3]
    around = box(centre - 2e-5, centre + 2e-5, frame)
    square = np.array([(3.8e-4, 4.8e-4, 0), (4.2e-4, 4.8e-4, 0), (4.2e-4, 5.2e-4, 0), (3.8e-4, 5.2e-4, 0)])
    column = KeepOut("nerve", frame, "polygon", square @ oct2frame[:3, :3].T + oct2frame[:3, 3])
    for region in (around, column):
        found = find_violations(line_path(5e-4), GEOMETRY, EnvelopeConfig(), [region], calibration, EE2BASE)
        # From the second waypoint the third is reached through the region.
        assert [violation.waypoint for violation in found] == [1, 2]
        assert repr(region.name) in found[1].reason
        assert "in the keep-out region" in found[1].reason
    far = [box(centre + 2.0e-3, centre + 3e-3, frame)]
    check_envelope(line_path(5e-4), GEOMETRY, EnvelopeConfig(), far, calibration, EE2BASE)


def test_a_thin_region_between_two_waypoints_counts_only_if_the_laser_fires_there(calibration):
    wall = box((3.4e-4, 0.0, 0.0), (3.6e-4, 1e-3, 1e-3))
    found = find_violations(line_path(5e-4), GEOMETRY, EnvelopeConfig(), [wall], calibration)
    assert [violation.waypoint for violation in found] == [1]
    turn = line_path(5e-4, segment=np.array([0, 0, 1, 1, 1]))
    assert not find_violations(turn, GEOMETRY, EnvelopeConfig(), [wall], calibration)


@pytest.mark.parametrize("x", np.linspace(3.02e-4, 3.95e-4, 8))
def test_a_box_of_3_um_on_the_way_is_met_wherever_it_is(calibration, x):
    centre = np.array([x, 5e-4, 5e-4])
    found = find_violations(
        line_path(5e-4), GEOMETRY, EnvelopeConfig(), [box(centre - 1.5e-6, centre + 1.5e-6)], calibration
    )
    assert [violation.waypoint for violation in found] == [1]
    beside = box(centre + np.array([-1e-6, 4e-6, -1e-6]), centre + np.array([1e-6, 6e-6, 1e-6]))
    assert not find_violations(line_path(5e-4), GEOMETRY, EnvelopeConfig(), [beside], calibration)


def test_a_box_that_the_beam_has_to_cross_is_met_and_one_below_the_focus_is_not(calibration):
    def found(region, **changes):
        path = line_path(5e-4, **changes)
        return find_violations(path, GEOMETRY, EnvelopeConfig(), [region], calibration)

    above = box((3.9e-4, 4.9e-4, 2.000e-4), (4.1e-4, 5.1e-4, 2.005e-4))
    assert [violation.waypoint for violation in found(above)] == [1, 2]
    assert "its beam comes within 2.0 um of the keep-out region 'vessel'" in found(above)[0].reason
    between = box((3.49e-4, 4.99e-4, 2.00e-4), (3.51e-4, 5.01e-4, 2.02e-4))
    assert [violation.waypoint for violation in found(between)] == [1]
    assert not found(above, laser_on=np.zeros(5, bool))
    assert not found(box((3e-4, 4e-4, 5.03e-4), (5e-4, 6e-4, 9e-4)))
    assert not found(box((3e-4, 4e-4, -9e-4), (5e-4, 6e-4, -1e-5)))  # above what was scanned
    # Tilted by 45 degrees towards x, the beam of the third waypoint comes down 0.3 mm beside it.
    tilted = np.tile(np.sqrt((0.5, 0.0, 0.5)), (5, 1))
    assert not found(above, axis=tilted, segment=np.arange(5))[1:]
    aside = box((0.9e-4, 4.9e-4, 1.9e-4), (1.1e-4, 5.1e-4, 2.1e-4))
    assert [violation.waypoint for violation in found(aside, axis=tilted, segment=np.arange(5))] == [2]
    assert not found(aside)


def test_a_region_along_the_path_is_walked_past_in_reasonable_time(calibration):
    wall = box((1e-4, 5.03e-4, 0.0), (9e-4, 6e-4, 1e-3))  # 3 um beside all beams
    assert not find_violations(line_path(5e-4), GEOMETRY, EnvelopeConfig(), [wall], calibration)


def test_clearance(calibration):
    region = [box((4e-4, 6e-4, 0.0), (5e-4, 7e-4, 1e-3))]
    check_envelope(line_path(5e-4), GEOMETRY, EnvelopeConfig(clearance_m=9e-5), region, calibration)
    with pytest.raises(PlanError, match=r"100\.0 um from the keep-out region 'vessel' \(box in oct\), nearer than 110"):
        check_envelope(line_path(5e-4), GEOMETRY, EnvelopeConfig(clearance_m=1.1e-4), region, calibration)


def test_a_region_in_the_base_frame_needs_the_pose_of_the_scan(calibration):
    with pytest.raises(PlanError, match="'vessel' is given in the robot's base frame, but the pose"):
        check_envelope(line_path(5e-4), GEOMETRY, EnvelopeConfig(), [box((0, 0, 0), (1, 1, 1), "base")], calibration)
    with pytest.raises(PlanError, match="a calibration"):
        check_envelope(line_path(5e-4), GEOMETRY, EnvelopeConfig(), [box((0, 0, 0), (1, 1, 1))])


def test_a_polygon_on_edge_is_none(calibration):
    upright = KeepOut("wall", "oct", "polygon", np.array([(0, 0, 0), (1e-3, 0, 0), (1e-3, 0, 1e-3)]))
    with pytest.raises(PlanError, match="'wall': seen along the beam"):
        check_envelope(line_path(5e-4), GEOMETRY, EnvelopeConfig(), [upright], calibration)


def test_a_plan_is_refused_as_a_whole(plane_field, calibration):
    region = box((5e-4, 1e-4, 0.0), (6e-4, 2e-4, 2e-3))
    plan_raster(plane_field, calibration, CORNER, OPPOSITE, tau=0.4)
    with pytest.raises(PlanError, match=r"keep-out region 'vessel'.*waypoint \d+ at"):
        plan_raster(plane_field, calibration, CORNER, OPPOSITE, tau=0.4, keep_out=[region])
    moved = invert(EE2BASE) @ EE2BASE @ calibration.oct2ee
    low = moved[:3, :3] @ (5e-4, 1e-4, 1.1e-3) + moved[:3, 3]
    in_ee = box(low - 2e-4, low + 2e-4, "ee")
    with pytest.raises(PlanError, match="box in ee"):
        plan_raster(plane_field, calibration, CORNER, OPPOSITE, tau=0.4, keep_out=[in_ee], scan_ee2base=EE2BASE)
    for envelope, words in (
        (EnvelopeConfig(max_slope_deg=10.0), "slopes"),
        (EnvelopeConfig(max_depth_m=1e-4), "too deep"),
        (EnvelopeConfig(min_confidence=1.0), "of low confidence"),
    ):
        with pytest.raises(PlanError, match=words):
            plan_raster(plane_field, calibration, CORNER, OPPOSITE, 0.0, PlannerConfig(envelope=envelope), tau=0.4)


def write(path, content):
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_keep_out_file(tmp_path, calibration):
    content = {
        "units": "m",
        "keep_out": [
            {"name": "vessel", "frame": "oct", "polygon_m": [[0, 0], [1.0e-3, 0], [0, 1.0e-3]]},
            {"name": "clamp", "frame": "base_link", "box": {"min_m": [0, 0, 0], "max_m": [0.1, 0.1, 0.1]}},
            {"name": "nerve", "frame": "tool0", "polygon_m": [[0, 0, 0], [1.0e-3, 0, 0], [0, 1.0e-3, 0]]},
        ],
    }
    vessel, clamp, nerve = load_keep_out(write(tmp_path / "k.yaml", content), calibration)
    assert (vessel.frame, clamp.frame, nerve.frame) == ("oct", "base", "ee")
    assert vessel.corners_m.shape == (3, 3)
    np.testing.assert_allclose(clamp.corners_m, [[0, 0, 0], [0.1, 0.1, 0.1]])


REGION = {"name": "a", "frame": "oct", "polygon_m": [[0, 0], [1, 0], [0, 1]]}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("units: m\n", "a list keep_out"),
        ({"units": "mm", "keep_out": []}, "units: m"),
        ({"units": "m", "keep_out": 3}, "a list keep_out"),
        ({"units": "m", "keep_out": [3]}, "region 0: expected name, frame"),
        ({"units": "m", "keep_out": [REGION | {"box": {}}]}, "region 0"),
        ({"units": "m", "keep_out": [REGION | {"frame": "map"}]}, "in 'map'"),
        ({"units": "m", "keep_out": [REGION | {"frame": "ee"}]}, r"finite corners \(x, y, z\)"),
        ({"units": "m", "keep_out": [REGION | {"polygon_m": [[0, "1e-3"], [1, 0], [0, 1]]}]}, "write 1.0e-3"),
        ({"units": "m", "keep_out": [REGION | {"polygon_m": [[0, 1, 2], [1, 0]]}]}, "corners of numbers"),
        ({"units": "m", "keep_out": [{"name": "b", "frame": "oct", "box": [0, 1]}]}, "min_m and max_m"),
        ({"units": "m", "keep_out": [{"name": "b", "frame": "oct", "box": {"min_m": [0, 0, 0], "max_m": [1, 1, 0]}}]},
         "min_m below max_m"),
        ("units: [m", "could not parse"),
    ],
)  # fmt: skip
def test_keep_out_files_that_are_none(tmp_path, calibration, content, words):
    with pytest.raises(PlanError, match=words):
        load_keep_out(write(tmp_path / "k.yaml", content), calibration)


def test_a_missing_file(tmp_path, calibration):
    with pytest.raises(PlanError, match="could not read"):
        load_keep_out(tmp_path / "none.yaml", calibration)


def test_limits_are_checked():
    with pytest.raises(ConfigurationError, match="max_slope_deg"):
        EnvelopeConfig(max_slope_deg=91.0)
