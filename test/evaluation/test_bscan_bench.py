"""`octn bench bscan`: figures of regions by hand, regions given and found, and the whole of it on a tiny phantom."""

import dataclasses
import json
import math

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError, QueryError
from octn_ros.evaluation import assess_field, bscan
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.bscan_config import BscanBenchConfig
from octn_ros.evaluation.fidelity import assess_regions
from octn_ros.evaluation.noise_reduction import reduce_noise
from octn_ros.evaluation.report import result_to_plain
from octn_ros.field import InterpolatedField
from octn_ros.metrics import RegionOfInterest
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import gaussian_filter_of_size, median_filter, save_volume

TINY = BscanBenchConfig(phantoms=("wavy-13dB-averaged",), shape=(8, 96, 32), steps=30)


@pytest.fixture(scope="module")
def result():
    return bscan.run(BenchmarkRequest(device="cpu"), TINY)


def test_regions_by_hand():
    """A field off by 0.1 in one region and right elsewhere: 20 dB there, SNR of means 0.5 and 0.6 over known noise."""
    measured = np.full((40, 40), 0.5, np.float32)
    measured[:20] = np.where(np.indices((20, 40)).sum(axis=0) % 2, 0.1, 0.3)
    rendered = measured.copy()
    rendered[25:35, 5:15] += 0.1
    regions = (
        RegionOfInterest("a", "air", (0, 20), (0, 40)),
        RegionOfInterest("t", "tissue", (25, 35), (5, 15)),
    )
    whole, air, tissue = assess_regions(measured, rendered, regions)
    assert tissue.psnr_db == pytest.approx(20.0, abs=1e-4)
    assert air.psnr_db == math.inf
    assert whole.psnr_db == pytest.approx(20.0 + 10 * math.log10(1600 / 100), abs=1e-4)
    assert tissue.snr_volume_db == pytest.approx(10 * math.log10(0.25 / 0.01), abs=1e-4)
    assert tissue.snr_field_db == pytest.approx(10 * math.log10(0.36 / 0.01), abs=1e-4)
    assert math.isnan(air.snr_volume_db)
    assert math.isnan(tissue.epi)  # the reference does not vary there
    assert air.epi == pytest.approx(1.0)


def test_the_same_figures_as_octn_eval():
    phantom = make_phantom(named_phantom("wavy-13dB-averaged", shape=(8, 96, 32)))
    field = InterpolatedField(gaussian_filter_of_size(phantom.volume))
    fidelity = assess_field(field, phantom.volume)
    regions = [entry.region for entry in fidelity.regions[1:]]
    again = assess_regions(fidelity.measured, fidelity.rendered, regions)
    assert len(again) == 4
    for one, other in zip(fidelity.regions, again, strict=True):
        for figure in ("psnr_db", "ssim", "snr_volume_db", "snr_field_db", "epi"):
            assert getattr(one, figure) == pytest.approx(getattr(other, figure), nan_ok=True)
    assert fidelity.regions[3].surface.chamfer_m > 0


def test_variants():
    volume = make_phantom(named_phantom("flat-13dB-averaged", shape=(4, 64, 16))).volume
    assert reduce_noise(volume, "raw") is volume
    np.testing.assert_array_equal(reduce_noise(volume, "median").array, median_filter(volume, 3).array)
    np.testing.assert_array_equal(reduce_noise(volume, "gaussian").array, gaussian_filter_of_size(volume, 3).array)
    with pytest.raises(ConfigurationError, match="expected one of raw, gaussian, median, got 'mean'"):
        reduce_noise(volume, "mean")


def test_the_whole_of_it_on_a_tiny_phantom(result):
    """Three variants, two presets, three regions each; smoother references are easier to match, as in the paper."""
    assert len(result.rows) == 18
    assert {row["roi"] for row in result.rows} == {"air", "tissue", "boundary"}
    tissue = {(row["variant"], row["preset"]): row for row in result.rows if row["roi"] == "tissue"}
    for row in tissue.values():
        assert row["bscan"] == 4
        assert row["psnr_change_db"] == pytest.approx(row["psnr_db"] - row["global_psnr_db"])
        assert row["snr_prediction_db"] > row["snr_truth_db"]
        assert 0.0 < row["epi"] < 1.1
    for preset in ("fast", "sparse"):
        raw, gaussian = tissue["raw", preset], tissue["gaussian", preset]
        assert gaussian["global_psnr_db"] > raw["global_psnr_db"]
        assert gaussian["snr_truth_db"] > raw["snr_truth_db"] + 3.0
        assert raw["noise_free_psnr_db"] > raw["input_noise_free_psnr_db"] + 2.0
    assert result.pictures["bscan-wavy-13dB-averaged.png"].startswith(b"\x89PNG")
    assert len(result.paper) == 18
    assert result.paper[9]["psnr_change_db"] == pytest.approx(4.73)
    json.dumps(result_to_plain(result, {}), allow_nan=False)


def test_given_regions_and_a_folder(tmp_path):
    """Regions of a file are taken as they are; one that lies outside a scan leaves that scan out, with the reason."""
    (tmp_path / "scans").mkdir()
    volume = make_phantom(named_phantom("wavy-13dB-averaged", shape=(6, 80, 32))).volume
    save_volume(tmp_path / "scans" / "good.nii", volume)
    save_volume(tmp_path / "scans" / "small.nii", make_phantom(named_phantom("flat", shape=(4, 70, 16))).volume)
    rois = [
        {"name": "R1", "kind": "tissue", "axial": [50, 70], "lateral": [2, 30]},
        {"name": "noise", "kind": "air", "axial": [0, 10], "lateral": [0, 32]},
    ]
    (tmp_path / "rois.json").write_text(json.dumps(rois))
    request = BenchmarkRequest(
        data=tmp_path / "scans", device="cpu", workers=1, regions=tmp_path / "rois.json"
    )  # fmt: skip
    config = dataclasses.replace(TINY, variants=("raw",), presets=("sparse",), steps=3)
    result = bscan.run(request, config)
    assert [(row["volume"], row["roi"]) for row in result.rows] == [("good.nii", "R1"), ("good.nii", "noise")]
    assert all("noise_free_psnr_db" not in row for row in result.rows)
    assert any("small.nii is left out" in note and "lie outside" in note for note in result.notes)
    assert result.configuration["regions"][0]["axial"] == [50, 70]
    with pytest.raises(QueryError, match=r"missing\.json"):
        bscan.run(dataclasses.replace(request, regions=tmp_path / "missing.json"), config)
