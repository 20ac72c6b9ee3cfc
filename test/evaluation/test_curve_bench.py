"""`octn bench curve`: figures of a curve by hand, and the whole of it on tiny phantoms."""

import dataclasses
import json
import math

import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation import curve
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.curve_config import CurveBenchConfig
from octn_ros.evaluation.curve_picture import training_curves
from octn_ros.evaluation.report import result_to_plain
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.training import PRESETS, FitResult
from octn_ros.training.progress import FitProgress
from octn_ros.volume import save_volume

TINY = CurveBenchConfig(phantoms=("wavy-13dB-averaged", "wavy-13dB-single-look"), shape=(8, 64, 32), seconds=0.5)


def report(seconds, stage, loss, psnr_db):
    return FitProgress(int(seconds * 4), 16, seconds, seconds / 4, stage, loss, psnr_db, 1e6)


def test_a_curve_by_hand():
    history = (
        report(0.25, "hybrid", 0.1, 20.0),
        report(0.5, "hybrid", 0.01, 29.9),
        report(0.75, "discrete", 0.005, 30.0),
        report(1.0, "discrete", 0.004, 31.0),
    )
    result = FitResult(None, 4, 1.0, 31.1, history, "time")
    figures = curve.curve_figures(result)
    assert figures["acceptable_s"] == 0.75
    assert (figures["switch_s"], figures["loss_switch"], figures["curve_switch_db"]) == (0.75, 0.01, 29.9)
    assert (figures["loss_first"], figures["loss_last"], figures["curve_first_db"]) == (0.1, 0.004, 20.0)
    assert figures["curve_stage"] == ["hybrid", "hybrid", "discrete", "discrete"]
    discrete = curve.curve_figures(dataclasses.replace(result, history=history[3:]))
    assert "switch_s" not in discrete
    assert "switch_s" not in curve.curve_figures(dataclasses.replace(result, history=history[:2]))
    assert curve.curve_figures(dataclasses.replace(result, history=history[:1]))["acceptable_s"] is None
    assert curve.curve_figures(dataclasses.replace(result, history=()))["curve_s"] == []


def test_the_whole_of_it_on_tiny_phantoms():
    """Each scan from its data and from random features, and with noise reduction; smoothed references are easier."""
    result = curve.run(BenchmarkRequest(device="cpu"), TINY)
    by_name = {(row["volume"], row["start"], row["noise_reduction"]): row for row in result.rows}
    assert len(by_name) == len(result.rows) == 8
    for name in TINY.phantoms:
        raw = by_name[name, curve.FROM_DATA, "raw"]
        assert raw["group"] == f"{name.removeprefix('wavy-13dB-')} phantoms"
        assert raw["seconds"] < 5.0
        assert raw["curve_s"] == sorted(raw["curve_s"])
        assert raw["curve_db"][-1] == pytest.approx(raw["psnr_db"], abs=0.5)
        assert 0 < raw["ssim"] < 1
        assert raw["noise_free_psnr_db"] > raw["psnr_db"]
        assert by_name[name, curve.RANDOM, "raw"]["psnr_db"] != raw["psnr_db"]
        for how in ("gaussian", "median"):
            assert by_name[name, curve.FROM_DATA, how]["psnr_db"] > raw["psnr_db"] + 2.0
    assert set(result.pictures) == {"curve-training.png", "curve-distributions.png", "curve-noise-reduction.png"}
    assert all(picture.startswith(b"\x89PNG") for picture in result.pictures.values())
    assert any("single-look phantoms, median before the fit: +" in note for note in result.notes)
    assert sum("raw scans reach 30 dB" in note for note in result.notes) == 2
    fits = result.configuration["fits"]
    assert [fits[start]["start_from_data"] for start in (curve.FROM_DATA, curve.RANDOM)] == [True, False]
    json.dumps(result_to_plain(result, {}), allow_nan=False)


def test_a_fit_that_ended_before_its_first_report_has_no_curve():
    row = {"start": curve.FROM_DATA, "curve_s": [], "curve_loss": [], "curve_db": [], "curve_stage": []}
    assert training_curves([row]).startswith(b"\x89PNG")


def test_a_folder_and_a_preset_without_stages(tmp_path):
    volume = make_phantom(named_phantom("wavy-13dB-averaged", shape=(6, 48, 24))).volume
    save_volume(tmp_path / "good.nii", volume)
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY rubbish")
    config = dataclasses.replace(TINY, preset="sparse", seconds=0.3, noise_reductions=("raw",))
    result = curve.run(BenchmarkRequest(data=tmp_path, device="cpu", workers=1), config)
    (row,) = result.rows
    assert (row["start"], row["group"], row["noise_free_psnr_db"]) == (curve.FROM_DATA, "scans", None)
    assert math.isfinite(row["psnr_db"])
    assert "switch_s" not in row
    assert PRESETS["sparse"].hybrid_share == 0.0
    assert any("bad.npy is left out" in note for note in result.notes)
    with pytest.raises(ConfigurationError, match="expected one of paper, fast, sparse, got 'slow'"):
        curve.run(BenchmarkRequest(), dataclasses.replace(TINY, preset="slow"))
