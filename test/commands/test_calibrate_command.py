"""`octn calibrate`: both methods from both formats, what they write, and what they refuse."""

import csv
import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from octn_ros.cli import main
from octn_ros.commands.calibrate import TRANSFORM_NAMES
from octn_ros.planning import load_calibration
from octn_ros.planning.calibration import TRANSFORMS
from octn_ros.planning.transforms import from_rotation, invert, quaternions_xyzw
from octn_ros.resources import config_path

TRUE = from_rotation(np.array([0.042, -0.018, 0.135]), Rotation.from_rotvec([0.1, -0.2, 0.5]).as_matrix())


def write_csv(path, rows):
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def matched(count=6, noise_m=2e-6, seed=0):
    generator = np.random.default_rng(seed)
    points = generator.uniform((0, 0, 5e-4), (3e-3, 3e-3, 2e-3), (count, 3))
    return points, points @ TRUE[:3, :3].T + TRUE[:3, 3] + noise_m * generator.standard_normal((count, 3))


def points_csv(path, points, ee):
    names = ("x_m", "y_m", "z_m", "ee_x_m", "ee_y_m", "ee_z_m")
    return write_csv(path, [dict(zip(names, row, strict=True)) for row in np.hstack([points, ee]).tolist()])


def sightings(count=10, seed=1):
    """Poses of the arm, and pose of a fixed fiducial in the scan at each."""
    generator = np.random.default_rng(seed)
    fiducial2base = from_rotation(np.array([0.4, 0.1, 0.02]), Rotation.from_rotvec([0.2, 0.1, 0.3]).as_matrix())
    ee2base, fiducial2oct = [], []
    for _ in range(count):
        turn = Rotation.from_rotvec(generator.normal(0.0, 0.15, 3)) * Rotation.from_euler("x", np.pi)
        place = TRUE[:3, :3] @ generator.uniform((0, 0, 5e-4), (3e-3, 3e-3, 2e-3)) + TRUE[:3, 3]
        pose = from_rotation(fiducial2base[:3, 3] - turn.as_matrix() @ place, turn.as_matrix())
        ee2base.append(pose)
        fiducial2oct.append(invert(pose @ TRUE) @ fiducial2base)
    return np.array(ee2base), np.array(fiducial2oct)


def pose_columns(poses, prefix=""):
    names = [f"{prefix}{name}" for name in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
    rows = np.hstack([poses[:, :3, 3], quaternions_xyzw(poses)]).tolist()
    return [dict(zip(names, row, strict=True)) for row in rows]


def plain(pose):
    return {"translation_m": pose[:3, 3].tolist(), "quaternion_xyzw": quaternions_xyzw(pose[None])[0].tolist()}


def test_names_are_those_of_the_calibration():
    assert TRANSFORM_NAMES == TRANSFORMS


def test_points_are_fitted_and_merged_into_a_calibration(tmp_path, capsys):
    data, output = points_csv(tmp_path / "points.csv", *matched()), tmp_path / "calibration.yaml"
    output.write_text(config_path("calibration.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    before = load_calibration(output)
    assert main(["calibrate", "points", str(data), "-o", str(output), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert np.array(values["matrix"])[:3, 3] == pytest.approx(TRUE[:3, 3], abs=2e-4)
    assert len(values["residual_m"]) == len(values["left_out_m"]) == 6
    assert values["residual_rms_m"] < 5e-6 < values["left_out_rms_m"] * 3
    after = load_calibration(output)
    np.testing.assert_allclose(after.oct2ee, values["matrix"], atol=1e-8)
    np.testing.assert_allclose(after.laser2ee, before.laser2ee)
    assert after.ee_frame == before.ee_frame
    assert dict(after.residual_rms_m) == {"oct2ee": pytest.approx(values["residual_rms_m"], rel=1e-3)}
    # The other transform beside it; the first one's residual stays.
    assert main(["calibrate", "points", str(data), "-o", str(output), "--transform", "laser2ee"]) == 0
    assert set(load_calibration(output).residual_rms_m) == {"oct2ee", "laser2ee"}
    assert "residuals" in capsys.readouterr().out


def test_a_new_file_says_what_it_lacks(tmp_path, capsys):
    points, ee = matched()
    data, output = tmp_path / "points.yaml", tmp_path / "new.yaml"
    rows = [{"from": p, "ee": q} for p, q in zip(points.tolist(), ee.tolist(), strict=True)]
    data.write_text(yaml.safe_dump({"units": "m", "points": rows}))
    assert main(["calibrate", "points", str(data), "-o", str(output), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missing"] == ["laser2ee"]
    assert main(["calibrate", "points", str(data), "-o", str(output), "--transform", "laser2ee", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missing"] == []
    np.testing.assert_allclose(load_calibration(output).oct2ee, load_calibration(output).laser2ee)


@pytest.mark.parametrize("oriented", [False, True])
@pytest.mark.parametrize("suffix", [".csv", ".yaml"])
def test_hand_eye_from_a_point_and_from_a_pose(tmp_path, oriented, suffix, capsys):
    ee2base, fiducial = sightings()
    data = tmp_path / f"poses{suffix}"
    if suffix == ".csv":
        seen = pose_columns(fiducial)
        seen = seen if oriented else [{name: row[name] for name in ("x_m", "y_m", "z_m")} for row in seen]
        write_csv(data, [a | b for a, b in zip(pose_columns(ee2base, "ee_"), seen, strict=True)])
    else:
        seen = [plain(pose) if oriented else pose[:3, 3].tolist() for pose in fiducial]
        poses = [{"ee2base": pose.tolist(), "fiducial": f} for pose, f in zip(ee2base, seen, strict=True)]
        data.write_text(yaml.safe_dump({"units": "m", "poses": poses}))
    assert main(["calibrate", "hand-eye", str(data), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(values["matrix"], TRUE, atol=1e-8)
    assert values["fiducial_base_m"] == pytest.approx([0.4, 0.1, 0.02], abs=1e-8)
    assert len(values["residual_m"]) == 10
    assert ("residual_rad" in values) == oriented
    assert values["calibration"] is None
    assert main(["calibrate", "hand-eye", str(data)]) == 0
    assert "standard deviations" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("p.csv", "x_m,y_m\n1,2\n", "got none of z_m, ee_x_m"),
        ("p.csv", "", "expected rows with the columns"),
        ("p.csv", "x_m,y_m,z_m,ee_x_m,ee_y_m,ee_z_m\n1,2,3,4,5,six\n", "expected numbers"),
        ("p.csv", "x_m,y_m,z_m,ee_x_m,ee_y_m,ee_z_m\n0,0,0,1,0,0\n1,1,1,2,1,1\n2,2,2,3,2,2\n", "on one line"),
        ("p.csv", "x_m,y_m,z_m,ee_x_m,ee_y_m,ee_z_m\n0,0,0,1,0,0\n1,1,1,2,1,1\n", "at least 3"),
        ("p.yaml", "units: mm\npoints: []\n", "units: m and a list points, got units: 'mm', points: list"),
        ("p.yaml", "units: m\npoint: 3\n", "got units: 'm', points: NoneType, keys ['point', 'units']"),
        ("p.yaml", "- 1\n", "got list '[1]'"),
        ("p.yaml", "units: m\npoints: []\n", "empty"),
        ("p.yaml", "units: m\npoints: [{from: [0, 0, 1e-3], ee: [0, 0, 0]}]\n", "write 1.0e-3"),
        ("p.yaml", "units: m\npoints: [{from: [0, 0, 0]}]\n", "ee and from"),
        ("p.yaml", "units: [m\n", "could not read"),
    ],
)
def test_bad_measurements_are_one_line_and_write_nothing(tmp_path, name, text, words, capsys):
    data, output = tmp_path / name, tmp_path / "calibration.yaml"
    data.write_text(text)
    assert main(["calibrate", "points", str(data), "-o", str(output)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("octn calibrate: error: ")
    assert words in error
    assert error.count("\n") == 1
    assert not output.exists()


def test_a_file_that_is_no_calibration_is_not_merged_into(tmp_path, capsys):
    data, output = points_csv(tmp_path / "points.csv", *matched()), tmp_path / "calibration.yaml"
    for text in ("- 1\n", "units: mm\n", "units: m\nlaser: 3\n", "units: [m\n"):
        output.write_text(text)
        assert main(["calibrate", "points", str(data), "-o", str(output)]) == 2
        assert output.read_text() == text
    assert capsys.readouterr().err.count("octn calibrate: error: ") == 4
