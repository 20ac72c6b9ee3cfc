"""`octn eval`: the figures as JSON and as a table, regions and truth from files, and what it refuses."""

import json

import pytest

from octn_ros.cli import main


def run(*arguments):
    return main(["eval", *map(str, arguments)])


def test_one_json_object_with_every_figure(field_file, capsys):
    assert run(field_file, field_file.parent / "scan.nii", "--device", "cpu", "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert 15 < values["psnr_db"] < 60
    assert 0 < values["ssim"] <= 1
    assert 0 < values["epi"] < 2
    assert [entry["surface"] for entry in values["surfaces"]] == ["raw voxels", "after a Gaussian of 1 voxel"]
    assert all(entry["chamfer_um"] <= entry["hausdorff_um"] for entry in values["surfaces"])
    assert list(values["fractional_psnr_db"]) == ["7.25", "7.5", "7.75"]
    assert values["spacing_um"] == pytest.approx([30, 15, 20])
    assert values["regions"][0]["kind"] == "whole"
    assert values["truth"] is None
    assert values["ssim_parameters"]["sigma"] == 1.5


def test_a_scan_against_itself_with_truth_regions_and_picture(scan_file, tmp_path, capsys):
    regions, picture = tmp_path / "regions.yaml", tmp_path / "bscan.png"
    regions.write_text("- {name: R1, kind: tissue, axial: [12, 24], lateral: [0, 16]}\n")
    assert run(scan_file, scan_file, "--truth", scan_file, "--rois", regions, "--picture", picture, "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert values["kind"] == "interpolated"
    assert values["truth"]["psnr_db"] > 100
    assert [entry["name"] for entry in values["regions"]] == ["whole", "R1"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_table_is_for_people(field_file, capsys):
    assert run(field_file, field_file.parent / "scan.nii") == 0
    output = capsys.readouterr().out
    for word in ("global", "SSIM", "fractional B-scans", "Chamfer", "after a Gaussian"):
        assert word in output


def test_arguments_in_the_wrong_order_are_told_apart(tmp_path, capsys):
    assert run(tmp_path / "scan.nii", tmp_path / "field.safetensors") == 2
    assert "octn eval FIELD VOLUME" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--rois", "missing.yaml"), "missing.yaml"),
        (("--picture", "picture.jpg"), "expected a picture to write as .png"),
        (("--truth", "missing.nii"), "missing.nii"),
        (("--device", "abacus"), "abacus"),
    ],
)
def test_bad_arguments_are_one_line(field_file, more, words, capsys):
    assert run(field_file, field_file.parent / "scan.nii", *more) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("octn eval: error: ")
    assert words in error
