"""`octn fit`: a field that can be read again, the settings it takes, and what it refuses."""

import json
import re
import typing

import pytest

from octn_ros.cli import main
from octn_ros.commands.fit import PRESET_NAMES


def fit(scan, output, *more):
    return main(["fit", str(scan), "-o", str(output), *more])


def test_the_presets_named_are_the_presets_there_are():
    from octn_ros.training import PRESETS

    assert set(PRESET_NAMES) == set(PRESETS)


def test_a_fit_writes_a_field_and_one_json_object(scan_file, tmp_path, capsys):
    from octn_ros.field import load_field

    output = tmp_path / "field.safetensors"
    assert fit(scan_file, output, "--steps", "12", "--alpha", "0.5", "--seed", "7", "--device", "cpu", "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert values["steps"] == 12
    assert values["field"] == str(output)
    assert values["config"]["alpha"] == 0.5
    assert values["config"]["seed"] == 7
    assert values["fit_s"] > 0
    field = load_field(output)
    assert field.geometry.shape == (14, 24, 16)
    assert field.description.training["steps"] == 12
    assert field.description.training["psnr_db"] == pytest.approx(values["psnr_db"])
    assert values["ended"] == "steps"
    assert values["history"][-1]["step"] == 12
    assert values["config"] == field.description.training["config"]


def test_a_target_and_a_start_field_shorten_the_fit(scan_file, tmp_path, capsys):
    output, again = tmp_path / "field.safetensors", tmp_path / "again.safetensors"
    more = ("--steps", "300", "--device", "cpu", "--json")

    def fitted(path, *options):
        assert fit(scan_file, path, *more, *options) == 0
        return json.loads(capsys.readouterr().out)

    whole = fitted(output)
    assert whole["ended"] == "steps"
    target = 0.5 * (whole["history"][0]["psnr_db"] + whole["history"][-1]["psnr_db"])
    assert target < whole["history"][-1]["psnr_db"]
    options = ("--target-psnr-db", str(target))
    anew, warm = fitted(again, *options), fitted(again, "--start", str(output), *options)
    assert anew["ended"] == warm["ended"] == "target"
    assert 300 > anew["steps"] > warm["steps"] == 0


def test_a_picture_on_request(scan_file, tmp_path, capsys):
    picture = tmp_path / "fit.png"
    more = ("--steps", "4", "--device", "cpu", "--picture", str(picture))
    assert fit(scan_file, tmp_path / "field.safetensors", *more) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_fit_that_diverged_says_so(scan_file, tmp_path, capsys, monkeypatch):
    from octn_ros.training.divergence import DivergenceGuard

    losses = iter([False] * 29 + [True])
    monkeypatch.setattr(DivergenceGuard, "diverged", lambda self, loss: next(losses))
    assert fit(scan_file, tmp_path / "field.safetensors", "--device", "cpu") == 0
    assert "diverged; this is the last good state" in capsys.readouterr().out
    assert (tmp_path / "field.safetensors").exists()


def test_the_table_is_for_people(unstated_file, tmp_path, capsys):
    spacing = ("--spacing-um", "20", "5", "20")
    assert fit(unstated_file, tmp_path / "f.safetensors", "--steps", "3", "--device", "cpu", *spacing) == 0
    output = capsys.readouterr()
    assert "PSNR against the measured voxels" in output.out
    assert "fitting the field" in output.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--preset", "slow"), "invalid choice: 'slow'"),
        (("--alpha", "1.5"), "alpha"),
        (("--steps", "0"), "steps"),
        (("--time-budget-s", "-1"), "time_budget_s"),
        (("--time-budget-s", "nan"), "time_budget_s"),
        (("--seed", "-3"), "seed"),
        (("--target-psnr-db", "-1"), "target_psnr_db"),
        (("--picture", "fit.jpg"), "ends in .png"),
        (("--start", "missing.safetensors"), "missing.safetensors"),
        (("--device", "abacus"), "abacus"),
        (("--spacing-um", "0", "5", "20"), "positive spacings"),
    ],
)
def test_a_bad_setting_is_one_line(scan_file, tmp_path, arguments, words, capsys):
    assert fit(scan_file, tmp_path / "field.safetensors", *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("octn fit: error: ")
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "field.safetensors").exists()


def test_bad_files_are_refused_before_and_after(scan_file, unstated_file, tmp_path, capsys):
    for scan, output in (
        (tmp_path / "missing.nii", tmp_path / "field.safetensors"),
        (unstated_file, tmp_path / "field.safetensors"),
        (scan_file, tmp_path / "missing" / "field.safetensors"),
        (scan_file, tmp_path),
        (scan_file, tmp_path / "field.nii"),
    ):
        assert fit(scan, output, "--steps", "1") == 2
        output = capsys.readouterr()
        assert output.out == ""
        assert output.err.startswith("octn fit: error: ")
        assert output.err.count("\n") == 1


def test_any_setting_by_its_path(scan_file, tmp_path, capsys):
    output = tmp_path / "field.safetensors"
    more = ("--steps", "2", "--device", "cpu", "--json")
    assert fit(scan_file, output, *more, "--set", "field.grid.levels=2", "--set", "backend=torch") == 0
    values = json.loads(capsys.readouterr().out)
    assert values["config"]["field"]["grid"]["levels"] == 2
    assert values["backend"] == "torch"
    assert values["samples"] == 2 * values["config"]["batch"]
    for wrong, says in (
        ("levels=2", "expected one of the settings .*batch.*, got 'levels'"),
        ("field.grid=2", r"expected field\.grid\.SETTING|expected grid\.SETTING"),
        ("batch.size=2", "expected one value"),
        ("field.grid.levels=many", "HashGridConfig.levels: expected int, got 'many'"),
        ("levels", "expected NAME=VALUE, got 'levels'"),
    ):
        assert fit(scan_file, output, *more, "--set", wrong) == 2
        assert re.search(says, capsys.readouterr().err)


def test_every_end_of_a_fit_has_its_words():
    from octn_ros.commands.fit import ENDS
    from octn_ros.training.fit import Ended

    assert set(ENDS) == set(typing.get_args(Ended))
