"""`octn bench slices`: the truth between the B-scans is the same tissue's, and the whole of it on a tiny phantom."""

import dataclasses
import json

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation import slices
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.fractional import anchor_bscan, proxy_bscans, true_bscans
from octn_ros.evaluation.report import result_to_plain
from octn_ros.evaluation.slices_config import SlicesBenchConfig
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import Volume, save_volume

TINY = SlicesBenchConfig(phantoms=("wavy-13dB-averaged",), shape=(8, 64, 32), steps=40)


@pytest.mark.parametrize("name", ["wavy-13dB-averaged", "rough", "steep30", "stepped", "glare", "shadow", "dye"])
def test_four_times_the_bscans_are_the_same_tissue(name):
    """Every fourth B-scan of the denser phantom is the phantom's own, to the last bit, so those between are its too."""
    config = named_phantom(name, shape=(8, 192, 32), seed=3, tissue_seed=3)
    bscan_m, axial_m, lateral_m = config.spacing_m
    dense = dataclasses.replace(config, shape=(29, 192, 32), spacing_m=(bscan_m / 4, axial_m, lateral_m))
    whole = make_phantom(dense).truth.array
    np.testing.assert_array_equal(whole[::4], make_phantom(config).truth.array)
    np.testing.assert_array_equal(true_bscans(config, 4), whole[17:20])


def test_moving_tissue_has_no_truth_between():
    assert true_bscans(named_phantom("motion", shape=(8, 64, 32)), 4) is None


@pytest.mark.parametrize(("bscans", "anchor"), [(256, 128), (9, 4), (8, 4), (3, 1), (2, 0)])
def test_the_anchors_of_the_paper(bscans, anchor):
    """(D/2, D/2 + 1) for even D, ((D-1)/2, (D+1)/2) for odd D; linear in between."""
    volume = Volume.from_array(np.float32(np.indices((bscans, 2, 2))[0]) / (bscans - 1), (1e-5,) * 3)
    assert anchor_bscan(volume) == anchor
    expected = (anchor + np.array([0.25, 0.5, 0.75])) / (bscans - 1)
    np.testing.assert_allclose(proxy_bscans(volume, anchor)[:, 1, 1], expected, rtol=1e-6)


def test_the_whole_of_it_on_a_tiny_phantom():
    told = []
    result = slices.run(BenchmarkRequest(device="cpu", progress=lambda *what: told.append(what)), TINY)
    assert [(row["method"], row["alpha"]) for row in result.rows] == [
        ("trilinear", None), ("fast", 0.0), ("fast", 0.2), ("sparse", None)
    ]  # fmt: skip
    plain, *fields = result.rows
    assert "psnr_db" not in plain
    for row in fields:
        assert row["anchor"] == 4
        assert 20 < row["psnr_0.5_db"] < 45
        assert row["truth_psnr_db"] > plain["truth_psnr_db"] + 2.0
        quarters = [row[f"truth_{quarter}_psnr_db"] for quarter in ("0.25", "0.5", "0.75")]
        assert min(quarters) <= row["truth_psnr_db"] <= max(quarters)
    assert fields[0]["psnr_db"] != fields[1]["psnr_db"]
    assert sum("nearer to the truth than trilinear" in note for note in result.notes) == 3
    assert result.pictures["slices-wavy-13dB-averaged.png"].startswith(b"\x89PNG")
    assert told
    json.dumps(result_to_plain(result, {}), allow_nan=False)


def test_a_folder_has_no_truth(tmp_path):
    volume = make_phantom(named_phantom("wavy-13dB-averaged", shape=(8, 48, 24))).volume
    save_volume(tmp_path / "good.nii", volume)
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY rubbish")
    result = slices.run(
        BenchmarkRequest(data=tmp_path, device="cpu", workers=1),
        dataclasses.replace(TINY, presets=("sparse",), steps=5),
    )
    assert [row["method"] for row in result.rows] == ["trilinear", "sparse"]
    assert all("truth_psnr_db" not in row for row in result.rows)
    assert any("bad.npy is left out" in note for note in result.notes)
    with pytest.raises(ConfigurationError, match="expected one of paper, fast, sparse, got 'slow'"):
        slices.run(BenchmarkRequest(), dataclasses.replace(TINY, presets=("slow",)))
