from pathlib import Path

import numpy as np
import pytest
import yaml

from octn_ros.errors import CalibrationError
from octn_ros.planning import Calibration, calibration_from_dict, load_calibration, quaternions_xyzw

SHIPPED = Path(__file__).parents[2] / "config" / "calibration.yaml"


@pytest.fixture
def content():
    return yaml.safe_load(SHIPPED.read_text())


def test_the_shipped_calibration_is_rigid_and_no_identity():
    calibration = load_calibration(SHIPPED)
    assert calibration.deviation < 1e-6
    assert (calibration.oct_frame, calibration.ee_frame) == ("oct_optical_frame", "tool0")
    assert (calibration.base_frame, calibration.laser_frame) == ("base_link", "laser_frame")
    assert np.abs(calibration.oct2ee - np.eye(4)).max() > 0.1
    # Coaxial: the beam of the laser is that of the probe.
    np.testing.assert_allclose(calibration.laser2ee[:3, 2], calibration.oct2ee[:3, 2], atol=1e-6)


def test_small_deviation_is_mended_and_reported(content):
    content["oct2ee"][0][0] += 8e-4
    calibration = calibration_from_dict(content)
    assert 1e-4 < calibration.deviation < 1e-3
    rotation = calibration.oct2ee[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)


def test_translation_and_quaternion_are_the_same_as_a_matrix(content):
    matrix = calibration_from_dict(content)
    for name in ("oct2ee", "laser2ee"):
        pose = getattr(matrix, name)
        content[name] = {
            "translation_m": pose[:3, 3].tolist(),
            "quaternion_xyzw": quaternions_xyzw(pose[None])[0].tolist(),
        }
    both = calibration_from_dict(content)
    np.testing.assert_allclose(both.oct2ee, matrix.oct2ee, atol=1e-12)
    np.testing.assert_allclose(both.laser2ee, matrix.laser2ee, atol=1e-12)


def test_the_length_of_a_quaternion_is_its_deviation(content):
    content["oct2ee"] = {"translation_m": [0, 0, 0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0008]}
    calibration = calibration_from_dict(content)
    assert calibration.deviation == pytest.approx(8e-4, rel=1e-3)
    np.testing.assert_allclose(calibration.oct2ee, np.eye(4), atol=1e-12)
    content["oct2ee"]["quaternion_xyzw"] = [0.0, 0.0, 0.0, 1.002]
    with pytest.raises(CalibrationError, match=r"oct2ee: .* of unit length"):
        calibration_from_dict(content)


def test_residuals_travel_with_a_calibration(content):
    assert calibration_from_dict(content).residual_rms_m == {}
    content["residual_rms_m"] = {"oct2ee": 1.2e-5}
    calibration = calibration_from_dict(content)
    assert calibration.residual_rms_m == {"oct2ee": 1.2e-5}
    with pytest.raises(TypeError):
        calibration.residual_rms_m["oct2ee"] = 0.0


def test_a_calibration_cannot_be_changed(content):
    calibration = calibration_from_dict(content)
    with pytest.raises(ValueError, match="read-only"):
        calibration.oct2ee[0, 0] = 2.0


def scaled(rows):
    return [[1.01 * value for value in row] for row in rows[:3]] + rows[3:]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.pop("units"), r"missing \['units'\]"),
        (lambda c: c.update(units="mm"), "expected units: m, got units: mm"),
        (lambda c: c.pop("laser2ee"), r"missing \['laser2ee'\]"),
        (lambda c: c.update(ee2oct=c.pop("oct2ee")), r"missing \['oct2ee'\] and unknown \['ee2oct'\]"),
        (lambda c: c.update(oct2ee=scaled(c["oct2ee"])), "oct2ee: expected a rotation within 0.001"),
        (lambda c: c["laser2ee"][0].__setitem__(3, float("nan")), "laser2ee: expected finite"),
        (lambda c: c["laser2ee"][0].__setitem__(3, "1e-3"), "write 1.0e-3, not 1e-3"),
        (lambda c: c["laser2ee"][0].__setitem__(3, True), "expected four rows of four numbers, got True"),
        (lambda c: c.update(oct2ee="identity"), "expected four rows of four numbers"),
        (lambda c: c["oct2ee"].pop(), "oct2ee: expected a transform of 4x4"),
        (lambda c: c["oct2ee"][1].pop(), "oct2ee: expected a transform of 4x4"),
        (lambda c: c.update(oct2ee={"translation_m": [0, 0, 0]}), "translation_m and quaternion_xyzw"),
        (lambda c: c.update(oct2ee={"translation_m": [0, 0], "quaternion_xyzw": [0, 0, 0, 1]}), "3 . 4 numbers"),
        (lambda c: c.update(oct2ee={"translation_m": [0, 0, "1e-3"], "quaternion_xyzw": [0, 0, 0, 1]}), "1.0e-3"),
        (lambda c: c.update(residual_rms_m={"probe": 1e-5}), "residual_rms_m: expected metres"),
        (lambda c: c.update(residual_rms_m={"oct2ee": -1e-5}), "residual_rms_m: expected metres"),
        (lambda c: c.update(residual_rms_m=1e-5), "residual_rms_m: expected metres"),
        (lambda c: c.update(ee_frame=""), "ee_frame: expected the name of a frame"),
        (lambda c: c.update(base_frame=7), "base_frame: expected the name of a frame, got 7"),
    ],
)
def test_wrong_content_is_refused_in_words(content, tmp_path, change, words):
    change(content)
    with pytest.raises(CalibrationError, match=words):
        calibration_from_dict(content)
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError, match=r"calibration\.yaml"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "expected the keys units, oct2ee, laser2ee and|expected the keys units, oct2ee, laser2ee, got NoneType"),
        (b"- 1\n- 2\n", "got list"),
        (b"units: [m\n", "could not parse"),
        (b"units: !!python/object/apply:os.getcwd []\n", "could not parse"),
        (b"\xff\xfe\x00\x01", "could not"),
    ],
)
def test_unreadable_files(tmp_path, text, words):
    path = tmp_path / "calibration.yaml"
    path.write_bytes(text)
    with pytest.raises(CalibrationError, match=words):
        load_calibration(path)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(CalibrationError, match="could not read"):
        load_calibration(tmp_path / "none.yaml")
    with pytest.raises(CalibrationError, match="could not read"):
        load_calibration(tmp_path)


def test_made_by_hand_it_is_checked_too():
    with pytest.raises(CalibrationError, match="laser2ee: expected a rotation"):
        Calibration(oct2ee=np.eye(4), laser2ee=2 * np.eye(4) - np.diag([0.0, 0.0, 0.0, 1.0]))
