"""`octn bench alpha`: the paper's trend on a tiny phantom, the block around the surface, a folder with a bad scan."""

import dataclasses
import json

import numpy as np
import pytest

from octn_ros.evaluation import alpha
from octn_ros.evaluation.alpha_config import QUICK, AlphaBenchConfig
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.environment import environment
from octn_ros.evaluation.report import markdown, result_to_plain
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import save_volume

SHAPE = (8, 24, 24)
TINY = AlphaBenchConfig(
    phantoms=("wavy-15dB-averaged",),
    shape=SHAPE,
    alphas=(0.0, 0.2),
    fit=dataclasses.replace(QUICK.fit, steps=60, batch=1024),
)


def test_the_trend_of_the_paper():
    """From alpha 0 to 0.2 the grid falls and what lies between the B-scans rises: averaged speckle, a tiny field."""
    told = []
    result = alpha.run(BenchmarkRequest(device="cpu", progress=lambda *what: told.append(what)), TINY)
    none, fifth = result.rows
    assert [none["alpha"], fifth["alpha"]] == [0.0, 0.2]
    assert fifth["slice_psnr_db"] > none["slice_psnr_db"] + 1.5
    assert none["volume_psnr_db"] - 3.0 < fifth["volume_psnr_db"] < none["volume_psnr_db"]
    assert none["slice_psnr_db"] < none["volume_psnr_db"]
    assert none["paper_slice_psnr_db"] == 22.86
    assert "slice_psnr_sd_db" not in none
    assert told
    assert {"alpha-curves.png", "alpha-wavy-15dB-averaged.png"} == set(result.pictures)
    assert all(picture.startswith(b"\x89PNG") for picture in result.pictures.values())
    assert any("in the paper by +0.09 and +4.33 dB" in note for note in result.notes)
    json.dumps(result_to_plain(result, {}), allow_nan=False)


def test_a_folder(tmp_path):
    """The mean is over the scans of a folder; one that cannot be read is said and stops nothing."""
    for seed in (0, 1):
        volume = make_phantom(named_phantom("wavy-15dB-averaged", shape=(10, 40, 26), seed=seed)).volume
        save_volume(tmp_path / f"{seed}.nii", volume)
    (tmp_path / "bad.nii").write_bytes(b"rubbish")
    config = dataclasses.replace(TINY, alphas=(0.4,), fit=dataclasses.replace(TINY.fit, steps=3))
    result = alpha.run(BenchmarkRequest(data=tmp_path, device="cpu", workers=1), config)
    (row,) = result.rows
    assert row["scans"] == 2
    assert row["volume_psnr_sd_db"] > 0
    assert any("bad.nii is left out" in note for note in result.notes)
    assert "| 0.4 | 2 |" in markdown(result, environment("cpu"))


def test_nothing_that_can_be_used(tmp_path):
    (tmp_path / "bad.nii").write_bytes(b"rubbish")
    result = alpha.run(BenchmarkRequest(data=tmp_path, device="cpu", workers=1), TINY)
    assert not result.rows
    assert not result.pictures
    assert "bad.nii is left out" in markdown(result, environment("cpu"))


@pytest.mark.parametrize("depth_voxels", [12, 60, 90])
def test_the_block_holds_the_surface(depth_voxels):
    """Wherever the surface lies, the block has it, at a quarter of its rows if there is room."""
    phantom = make_phantom(
        named_phantom("flat-15dB-averaged", shape=(10, 100, 30), surface_depth_m=depth_voxels * 14.59e-6)
    )
    block = alpha.surface_block(phantom.volume, (8, 32, 20))
    assert block.geometry.shape == (8, 32, 20)
    first = round(block.geometry.origin_m[2] / 14.59e-6)
    assert first == pytest.approx(np.clip(depth_voxels - 8, 0, 68), abs=2)
    np.testing.assert_array_equal(block.array, phantom.volume.array[1:9, first : first + 32, 5:25])
