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
    assert len(np.unique(surface[:, 1].round(9))) == 6


def test_a_csv_has_one_line_for_each_waypoint(field_file, tmp_path, capsys):
    output = tmp_path / "plan.csv"
    assert plan(field_file, output, "--corner-mm", "0.1", "0.1", "--opposite-mm", "0.2", "0.3") == 0
    table = capsys.readouterr().out
    with output.open(encoding="utf-8", newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert tuple(lines[0]) == CSV_COLUMNS
    assert f"{len(lines)} of " in table
    quaternions = np.array([[float(line[name]) for name in ("qx", "qy", "qz", "qw")] for line in lines])
    assert np.linalg.norm(quaternions, axis=1) == pytest.approx(1.0)
    assert {line["laser_on"] for line in lines} == {"1"}


def test_a_turned_default_rectangle_fits(field_file, tmp_path, capsys):
    assert plan(field_file, tmp_path / "plan.csv", "--angle-deg", "30") == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--corner-mm", "0.1", "0.1"), "--opposite-mm together"),
        (("--corner-mm", "0.1", "0.1", "--opposite-mm", "9", "0.3"), "inside the scan"),
        (("--corner-mm", "0.1", "nan", "--opposite-mm", "0.2", "0.3"), "finite"),
        (("--line-spacing-um", "nan"), "finite"),
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
