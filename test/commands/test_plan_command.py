"""`octn plan`: the plan as JSON and CSV, the rectangle it takes, and what it refuses."""

import csv
import json

import numpy as np
import pytest

from octn_ros.cli import main
from octn_ros.commands.plan import CSV_COLUMNS
from octn_ros.resources import config_path

CALIBRATION = str(config_path("calibration.yaml"))


def plan(field, output, *more):
    return main(["plan", str(field), "--calibration", CALIBRATION, "-o", str(output), *more])


def test_a_plan_lies_on_the_surface_in_the_end_effector_frame(field_file, tmp_path, capsys):
    from octn_ros.planning import load_calibration

    output = tmp_path / "plan.json"
    assert plan(field_file, output, "--json", "--line-spacing-um", "60") == 0
    values = json.loads(capsys.readouterr().out)
    written = json.loads(output.read_text())
    surface = np.array(written["waypoints"]["surface_oct_m"])
    assert values["waypoints"] == len(surface) == values["requested"] - values["given_up"]
    assert values["waypoints"] > 0.8 * values["requested"]
    # The bright half space begins at axial voxel 8 + 0.1 lateral + 0.05 bscan, of 15 um.
    truth = 15e-6 * (8 + 0.1 * surface[:, 0] / 20e-6 + 0.05 * surface[:, 1] / 30e-6)
    assert np.sqrt(np.mean((surface[:, 2] - truth) ** 2)) < 15e-6
    oct2ee = load_calibration(CALIBRATION).oct2ee
    expected = surface @ oct2ee[:3, :3].T + oct2ee[:3, 3]
    assert np.array(written["waypoints"]["position_m"]) == pytest.approx(expected, abs=1e-9)
    # The largest centred rectangle, with its margin of two voxels on every side.
    assert surface[:, :2].min(axis=0) == pytest.approx((40e-6, 60e-6), abs=1e-9)
    assert np.ptp(surface[:, :2], axis=0) == pytest.approx((220e-6, 270e-6), abs=1e-9)
    assert values["lateral_m"] == pytest.approx([40e-6, 260e-6], abs=1e-9)
    assert values["bscan_m"] == pytest.approx([60e-6, 330e-6], abs=1e-9)
    assert len(np.unique(surface[:, 1].round(9))) == 6


def test_a_csv_has_one_line_for_each_waypoint(field_file, tmp_path, capsys):
    output = tmp_path / "plan.csv"
    assert plan(field_file, output, "--corner-mm", "0.1", "0.1", "--opposite-mm", "0.2", "0.3") == 0
    table = capsys.readouterr().out
    with output.open(encoding="utf-8", newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert tuple(lines[0]) == CSV_COLUMNS
    assert f"{len(lines)} of " in table
    assert "0.100 to 0.200 mm lateral, 0.100 to 0.300 mm bscan" in " ".join(table.split())
    quaternions = np.array([[float(line[name]) for name in ("qx", "qy", "qz", "qw")] for line in lines])
    assert np.linalg.norm(quaternions, axis=1) == pytest.approx(1.0)
    assert {line["laser_on"] for line in lines} == {"1"}


def test_a_turned_default_rectangle_fits(field_file, tmp_path, capsys):
    assert plan(field_file, tmp_path / "plan.csv", "--angle-deg", "30") == 0


def test_centre_and_size_with_leads_and_a_picture(field_file, tmp_path, capsys):
    output, picture = tmp_path / "plan.csv", tmp_path / "plan.png"
    arguments = ["--centre-mm", "0.15", "0.195", "--size-mm", "0.1", "0.1", "--lead-in-um", "20", "--one-way"]
    assert plan(field_file, output, *arguments, "--picture", str(picture), "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert values["picture"] == str(picture)
    assert values["leads"] == 3
    assert values["coverage"]["line_gap_m"] == pytest.approx(50e-6)
    assert values["error_budget"]["total_um"] > 0
    with output.open(encoding="utf-8", newline="") as stream:
        lines = list(csv.DictReader(stream))
    fired = [line["laser_on"] == "1" for line in lines]
    assert (fired.count(True), fired.count(False)) == (values["waypoints"], 3)
    assert not fired[0]
    assert fired[-1]


def test_a_polygon_and_settings_from_files(field_file, tmp_path, capsys):
    polygon, settings = tmp_path / "polygon.csv", tmp_path / "settings.yaml"
    polygon.write_text("x_m,y_m\n0.0001,0.0001\n0.0002,0.0001\n0.0001,0.0003\n")
    settings.write_text("speed_m_s: 0.002\nraster: {line_spacing_m: 2.0e-05, point_spacing_along: lateral}\n")
    output = tmp_path / "plan.json"
    arguments = ["--polygon", str(polygon), "--settings", str(settings), "--standoff-um", "100", "--json"]
    assert plan(field_file, output, *arguments, "--orientation", "normal", "--point-spacing-um", "25") == 0
    written = json.loads(output.read_text())
    assert written["config"]["raster"]["line_spacing_m"] == 2e-5
    assert written["config"]["raster"]["point_spacing_m"] == pytest.approx(25e-6)
    assert written["config"]["waypoints"]["standoff_m"] == pytest.approx(1e-4)
    assert set(written["waypoints"]["speed_m_s"]) == {0.002}
    surface = np.array(written["waypoints"]["surface_oct_m"])
    assert (surface[:, 0] / 1e-4 - 1 + (surface[:, 1] / 1e-4 - 1) / 2 <= 1 + 1e-4).all()
    assert json.loads(capsys.readouterr().out)["coverage"]["area_m2"] == pytest.approx(1e-8, rel=0.01)


def test_a_scan_is_planned_on_as_it_is(scan_file, tmp_path, capsys):
    assert plan(scan_file, tmp_path / "plan.json", "--order", "trilinear", "--json") == 0
    written = json.loads((tmp_path / "plan.json").read_text())
    assert written["field_kind"] == "interpolated"
    assert json.loads(capsys.readouterr().out)["field_hash"] == ""


def test_keep_out_regions_refuse_a_plan(field_file, tmp_path, capsys):
    keep_out, pose = tmp_path / "keep_out.yaml", tmp_path / "pose.yaml"
    region = "{name: vessel, frame: FRAME, box: {min_m: [-1, -1, -1], max_m: [1, 1, 1]}}"
    pose.write_text("units: m\nee2base: {translation_m: [0.4, 0, 0.3], quaternion_xyzw: [1, 0, 0, 0]}\n")
    for frame, more, words in (
        ("oct", [], "keep-out region 'vessel'"),
        ("base", [], "pose of the end effector"),
        ("base", ["--scan-pose", str(pose)], "box in base"),
    ):
        keep_out.write_text("units: m\nkeep_out: [" + region.replace("FRAME", frame) + "]\n")
        assert plan(field_file, tmp_path / "plan.json", "--keep-out", str(keep_out), *more) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "plan.json").exists()


@pytest.mark.parametrize(
    ("option", "text", "words"),
    [
        ("--polygon", "x,y\n0,0\n", "columns x_m, y_m, in metres, got the columns x, y"),
        ("--polygon", "x_m,y_m\n0,zero\n", "corners in metres"),
        ("--polygon", "x_m,y_m\n0,0\n", "3 to 1000 corners"),
        ("--settings", "- 1\n", "planner settings"),
        ("--settings", "speed: 1\n", "got unknown ['speed']"),
        ("--settings", "raster: {order: spiral}\n", "zigzag, one-way"),
        ("--settings", "a: [\n", "expected YAML"),
        ("--keep-out", "units: m\n", "a list keep_out"),
        ("--scan-pose", "units: m\n", "ee2base"),
        ("--scan-pose", "units: m\nee2base: [[1, 0], [0, 1]]\n", "4x4"),
    ],
)
def test_files_of_another_form_are_one_line(field_file, tmp_path, option, text, words, capsys):
    (tmp_path / "file").write_text(text)
    assert plan(field_file, tmp_path / "plan.json", option, str(tmp_path / "file")) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert plan(field_file, tmp_path / "plan.json", option, str(tmp_path / "missing")) == 2
    assert "could not read it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--corner-mm", "0.1", "0.1"), "--opposite-mm together"),
        (("--corner-mm", "0.1", "0.1", "--opposite-mm", "9", "0.3"), "inside the scan"),
        (("--corner-mm", "1e-4", "1e-4", "--opposite-mm", "2e-4", "3e-4"), "metres are multiplied by 1000"),
        (("--centre-mm", "0.2", "0.2", "--size-mm", "2e-4", "3e-4"), "got one of 0.2 x 0.3 um"),
        (("--corner-mm", "0.1", "nan", "--opposite-mm", "0.2", "0.3"), "finite"),
        (("--line-spacing-um", "nan"), "finite"),
        (("--centre-mm", "0.1", "0.1"), "--size-mm together"),
        (("--centre-mm", "0.1", "0.1", "--size-mm", "0", "0.1"), "two sides above 0"),
        (("--centre-mm", "0.1", "0.1", "--size-mm", "0.1", "0.1", "--polygon", "p.csv"), "one region"),
        (("--standoff-um", "10", "--depth-offset-um", "10"), "got both"),
        (("--picture", "plan.jpg"), "as .png"),
        (("--margin-um", "300"), "margin leaves nothing"),
        (("--line-spacing-um", "0"), "line_spacing_m"),
        (("--angle-deg", "inf"), "finite"),
    ],
)
def test_a_bad_request_is_one_line_and_writes_nothing(field_file, tmp_path, arguments, words, capsys):
    assert plan(field_file, tmp_path / "plan.json", *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("octn plan: error: ")
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "plan.json").exists()


def test_bad_files_are_one_line(field_file, tmp_path, capsys):
    truncated, foreign, calibration = (tmp_path / name for name in ("half.safetensors", "x.safetensors", "bad.yaml"))
    truncated.write_bytes(field_file.read_bytes()[:-100])
    foreign.write_text("no field")
    calibration.write_text("units: mm\n")
    for arguments in (
        [tmp_path / "missing.safetensors", "--calibration", CALIBRATION, "-o", tmp_path / "plan.json"],
        [truncated, "--calibration", CALIBRATION, "-o", tmp_path / "plan.json"],
        [foreign, "--calibration", CALIBRATION, "-o", tmp_path / "plan.json"],
        [field_file, "--calibration", tmp_path / "missing.yaml", "-o", tmp_path / "plan.json"],
        [field_file, "--calibration", calibration, "-o", tmp_path / "plan.json"],
        [field_file, "--calibration", CALIBRATION, "-o", tmp_path / "plan.txt"],
        [field_file, "--calibration", CALIBRATION, "-o", tmp_path / "missing" / "plan.json"],
    ):
        assert main(["plan", *map(str, arguments)]) == 2
        output = capsys.readouterr()
        assert output.out == ""
        assert output.err.startswith("octn plan: error: ")
        assert output.err.count("\n") == 1
