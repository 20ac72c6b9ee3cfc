"""`octn info`: what it tells, and how it refuses a bad file."""

import json
import subprocess
import sys

import numpy as np
import pytest

from octn_ros.cli import main
from octn_ros.volume import Volume, load_volume, save_volume


def test_json_tells_shape_spacing_and_intensity(scan_file, capsys):
    assert main(["info", str(scan_file), "--json"]) == 0
    output = capsys.readouterr()
    values = json.loads(output.out)
    assert output.err == ""
    assert values["shape"] == [14, 24, 16]
    assert values["spacing_um"] == pytest.approx([30, 15, 20], rel=1e-5)
    assert values["spacing_from"] == "file"
    assert values["extent_mm"] == pytest.approx({"lateral": 0.3, "bscan": 0.39, "axial": 0.345}, rel=1e-5)
    assert (values["dtype"], values["bytes"], values["intensity_scale"]) == ("uint8", 14 * 24 * 16, "log")
    assert 0 <= values["intensity"]["min"] < values["intensity"]["median"] < values["intensity"]["max"] <= 255


def test_json_tells_histogram_surface_and_snr(scan_file, capsys):
    # The scan's surface lies 8 to 10.2 rows deep; its noise is 0.02, its tissue about 0.6 brighter than its air.
    assert main(["info", str(scan_file), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert sum(values["histogram"]["counts"]) == values["voxels"]
    assert len(values["histogram"]["edges"]) == len(values["histogram"]["counts"]) + 1
    low, high = values["surface"]["row_range"]
    assert 7.5 <= low <= values["surface"]["median_row"] <= high <= 10.7
    assert values["surface"]["median_depth_um"] == pytest.approx(values["surface"]["median_row"] * 15)
    assert values["snr_db"] == pytest.approx(27, abs=3)


@pytest.mark.parametrize("suffix", [".npz", ".tif", ".nii"])
def test_every_format_is_told_alike(scan_file, tmp_path, suffix, capsys):
    copy = tmp_path / f"copy{suffix}"
    save_volume(copy, load_volume(scan_file))
    told = []
    for path in (scan_file, copy):
        assert main(["info", str(path), "--json"]) == 0
        told.append({**json.loads(capsys.readouterr().out), "file": ""})
    assert told[0] == told[1]


@pytest.mark.parametrize("suffix", [".npz", ".tif", ".nii", ".nii.gz"])
def test_the_header_alone_says_the_same_and_no_voxel_is_read(scan_file, tmp_path, suffix, capsys, monkeypatch):
    copy = tmp_path / f"copy{suffix}"
    save_volume(copy, load_volume(scan_file))
    assert main(["info", str(copy), "--json"]) == 0
    whole = json.loads(capsys.readouterr().out)
    monkeypatch.setattr(Volume, "__post_init__", None)  # no volume can be made
    assert main(["info", str(copy), "--header", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {key: whole[key] for key in told}
    assert whole.keys() - told.keys() == {"intensity", "histogram", "surface", "snr_db"}
    assert main(["info", str(copy), "--header"]) == 0
    assert "14 B-scans x 24 axial x 16 lateral" in " ".join(capsys.readouterr().out.split())


def test_the_header_tells_no_range_of_floats(tmp_path, capsys):
    np.save(tmp_path / "scan.npy", np.random.default_rng(0).random((4, 5, 6)))
    spacing = ["--spacing-um", "20", "5", "20"]
    assert main(["info", str(tmp_path / "scan.npy"), "--header", *spacing]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "120 of type float32" in text
    assert "as the voxels have it" in text
    assert main(["info", str(tmp_path / "scan.npy"), "--header", "--normalise", "minmax", *spacing]) == 2
    assert "--normalise" in capsys.readouterr().err


@pytest.mark.parametrize("bright", [1, 2000])
def test_a_scan_of_two_values_is_described(tmp_path, bright, capsys):
    array = np.zeros((10, 20, 20), np.uint8)
    array.reshape(-1)[-bright:] = 255
    save_volume(tmp_path / "scan.nii", Volume.from_array(array, (1e-5, 1e-5, 1e-5)))
    assert main(["info", str(tmp_path / "scan.nii"), "--json"]) == 0
    intensity = json.loads(capsys.readouterr().out)["intensity"]
    assert intensity == {"min": 0, "p1": 0, "median": 0, "p99": 0 if bright == 1 else 255, "max": 255}


def test_the_table_is_for_people(scan_file, capsys):
    assert main(["info", str(scan_file), "--spacing-um", "10", "5", "20"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "14 B-scans x 24 axial x 16 lateral" in text
    assert "10 x 5 x 20 um, from the arguments" in text
    assert "surface rows" in text
    assert " dB " in text
    assert "####" in text


@pytest.mark.parametrize("command", [["info"], ["convert", "out.npz"], ["slice", "bscan:3", "-o", "cut.png"]])
def test_a_spacing_in_millimetres_is_refused(command, scan_file, capsys):
    name, *rest = command
    assert main([name, str(scan_file), *rest, "--spacing-um", "0.028", "0.01459", "0.014"]) == 2
    said = capsys.readouterr().err
    assert "--spacing-um: expected micrometres, 0.1 or more, got 0.028; millimetres are multiplied by 1000" in said
    assert len(said.splitlines()) == 1


def test_a_spacing_that_contradicts_the_file_is_taken_with_a_warning(scan_file, caplog, capsys):
    assert main(["info", str(scan_file), "--json", "--spacing-um", "30", "15.3", "20"]) == 0
    assert json.loads(capsys.readouterr().out)["spacing_um"] == pytest.approx([30, 15.3, 20])
    (said,) = caplog.messages
    assert said == f"{scan_file}: the spacing given, 30 x 15.3 x 20 um, is taken; the file states 30 x 15 x 20 um"


def test_a_spacing_that_the_file_states_too_is_taken_without_a_word(scan_file, unstated_file, caplog):
    assert main(["info", str(scan_file), "--json", "--spacing-um", "30.1", "15", "20"]) == 0
    assert main(["info", str(unstated_file), "--json", "--spacing-um", "30", "15", "20"]) == 0
    assert caplog.messages == []


def test_info_needs_no_torch(scan_file):
    code = (
        "import sys; from octn_ros.cli import main\n"
        f"code = main(['info', {str(scan_file)!r}])\n"
        "sys.exit(code or any(name in sys.modules for name in ('torch', 'rclpy', 'zenoh', 'matplotlib')))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_spacing_has_to_come_from_somewhere(unstated_file, capsys):
    assert main(["info", str(unstated_file), "--json"]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("octn info: error: ")
    assert "--spacing-um BSCAN AXIAL LATERAL" in output.err
    assert main(["info", str(unstated_file), "--spacing-um", "20", "5", "20"]) == 0


@pytest.mark.parametrize("spacing", [("0", "5", "20"), ("20", "-5", "20"), ("20", "5", "nan"), ("inf", "5", "20")])
def test_a_spacing_that_is_none_is_refused(unstated_file, spacing, capsys):
    assert main(["info", str(unstated_file), "--spacing-um", *spacing]) == 2
    error = capsys.readouterr().err
    assert "three positive spacings" in error
    assert error.count("\n") == 1


def test_a_missing_empty_truncated_or_foreign_file_is_one_line(tmp_path, scan_file, capsys):
    truncated, empty, foreign = (tmp_path / name for name in ("truncated.nii.gz", "empty.nii", "foreign.nii"))
    truncated.write_bytes(scan_file.read_bytes()[:-200])
    empty.write_bytes(b"")
    foreign.write_text("not a volume, but long enough to hold a header " * 20)
    for path in (truncated, empty, foreign, tmp_path / "missing.nii", tmp_path):
        assert main(["info", str(path)]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"octn info: error: {path}: ")
        assert error.count("\n") == 1


@pytest.mark.parametrize("fill", [np.nan, np.inf])
def test_voxels_that_are_no_numbers_are_counted(tmp_path, fill, capsys):
    import nibabel

    array = np.random.default_rng(0).random((4, 5, 6), dtype=np.float32)
    array[1, 2, :3] = fill
    nibabel.save(nibabel.Nifti1Image(array, np.eye(4)), tmp_path / "bad.nii")
    assert main(["info", str(tmp_path / "bad.nii"), "--spacing-um", "20", "5", "20"]) == 2
    assert "got 3 NaN or infinite ones" in capsys.readouterr().err
