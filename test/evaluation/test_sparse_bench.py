"""`octn bench sparse`: interpolations and judgement worked by hand, nothing held out is seen, and the whole of it."""

import dataclasses
import json
import math

import numpy as np
import pytest

from octn_ros.errors import QueryError, VolumeError
from octn_ros.evaluation import sparse
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.interpolators import choose_smoothing, cubic, smoothed, trilinear
from octn_ros.evaluation.report import result_to_plain
from octn_ros.evaluation.scans import BenchScan, ScanSource
from octn_ros.evaluation.sparse_config import SparseBenchConfig
from octn_ros.evaluation.sparse_judgement import SparseJudge
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import Volume, save_volume, scan_files, subsample_bscans

TINY = SparseBenchConfig(phantoms=("wavy-13dB-averaged",), shape=(17, 64, 32), factors=(2, 4, 8), steps=50)
SPACING_M = (28e-6, 14.59e-6, 14e-6)


def test_interpolations_by_hand():
    """A quadratic along the slow axis: linear is off by t (1 - t), a spline hardly; beyond the ends both hold."""
    bscans = np.float32(np.arange(9.0) ** 2)[:, None, None] * np.ones((1, 2, 3), np.float32)
    positions = np.array([4.5, 4.25, 3.0, -1.0, 20.0])
    np.testing.assert_allclose(trilinear(bscans, positions)[:, 0, 0], [20.5, 18.25, 9.0, 0.0, 64.0])
    np.testing.assert_allclose(cubic(bscans, positions)[:, 1, 2], [20.25, 18.0625, 9.0, 0.0, 64.0], atol=0.02)


def test_smoothing_is_chosen_where_it_helps():
    """Noise that B-scans do not share asks for smoothing, edges alone ask for none."""
    generator = np.random.default_rng(0)
    axial, lateral = np.meshgrid(np.linspace(0, 3, 48), np.linspace(0, 3, 48), indexing="ij")
    tissue = np.float32(np.sin(axial) * np.cos(lateral))
    noisy = np.float32(tissue + generator.normal(0, 0.3, (9, 48, 48)))
    assert choose_smoothing(noisy) >= 2.0
    checked = np.float32(np.indices((48, 48)).sum(axis=0) % 2)
    assert choose_smoothing(np.stack([checked] * 5)) == 0.0
    assert smoothed(noisy, np.array([1.0]), 4.0).std() < trilinear(noisy, np.array([1.0])).std()
    with pytest.raises(QueryError, match="at least 3"):
        choose_smoothing(noisy[:2])


def test_figures_by_hand():
    """An error of 0.1 on every held-out B-scan is 20 dB; on the whole grid, where one of two is right, 3 dB more."""
    phantom = make_phantom(named_phantom("flat-13dB-averaged", shape=(9, 64, 16)))
    scan = subsample_bscans(phantom.volume, 2)
    judge = SparseJudge(phantom.volume, phantom.truth, scan)
    reconstruction = phantom.volume.normalized(slice(None))
    reconstruction[1::2] += 0.1
    figures = judge.judge(reconstruction)
    assert figures.psnr_db == pytest.approx(20.0, abs=1e-3)
    assert figures.psnr_sd_db == pytest.approx(0.0, abs=1e-3)
    assert figures.grid_psnr_db == pytest.approx(20.0 + 10 * math.log10(9 / 4), abs=1e-3)
    perfect = judge.judge(phantom.truth.normalized(slice(None)))
    assert perfect.truth_psnr_db == math.inf
    assert perfect.truth_epi == pytest.approx(1.0)
    assert perfect.truth_chamfer_um == 0.0
    assert perfect.truth_rise == 1.0
    half = 0.5 + 0.5 * phantom.truth.normalized(slice(None))
    assert judge.judge(half).truth_rise == pytest.approx(0.5)


def test_held_out_bscans_are_seen_by_no_method(monkeypatch):
    """Whatever stands in the B-scans that were not kept: the same reconstructions, only judged otherwise."""
    seen = []
    real = SparseJudge.judge

    def judge(self, reconstruction):
        seen.append(reconstruction.copy())
        return real(self, reconstruction)

    monkeypatch.setattr(SparseJudge, "judge", judge)
    phantom = make_phantom(named_phantom("wavy-13dB-averaged", shape=(17, 64, 32)))
    other = phantom.volume.array.copy()
    other[np.arange(17) % 4 != 0] = other.max() - other[np.arange(17) % 4 != 0]
    rows = []
    for volume in (phantom.volume, dataclasses.replace(phantom.volume, array=other)):
        source = ScanSource("scan", lambda volume=volume: BenchScan("scan", volume))
        monkeypatch.setattr(sparse, "scan_sources", lambda *_, source=source: [source])
        rows += sparse.run(BenchmarkRequest(device="cpu"), dataclasses.replace(TINY, factors=(4,))).rows
    assert len(seen) == 2 * len(sparse.METHODS)
    for one, two in zip(seen[:4], seen[4:], strict=True):
        np.testing.assert_array_equal(one, two)
    assert rows[0]["field_psnr_db"] > rows[1]["field_psnr_db"] + 5.0


def test_the_whole_of_it_on_a_tiny_phantom():
    """Rows with the promised keys, SFs that leave too few B-scans said, pictures drawn, JSON without NaN."""
    told = []
    result = sparse.run(BenchmarkRequest(device="cpu", progress=lambda *what: told.append(what)), TINY)
    assert [row["sf"] for row in result.rows] == [2, 4]
    assert any("SF 8 is left out: 3 B-scans" in note for note in result.notes)
    for row in result.rows:
        keys = ("volume", "sf", "field_psnr_db", "trilinear_psnr_db", "cubic_psnr_db", "smoothed_psnr_db", "chamfer_um")
        assert all(row[key] is not None for key in keys)
        assert 15 < row["field_psnr_db"] < 40
        assert row["field_truth_psnr_db"] > row["trilinear_truth_psnr_db"]
    assert {"sparse-curves.png", "sparse-wavy-13dB-averaged-sf2.png"} <= set(result.pictures)
    assert all(picture.startswith(b"\x89PNG") for picture in result.pictures.values())
    assert told
    json.dumps(result_to_plain(result, {}), allow_nan=False)


def test_a_folder_of_scans(tmp_path):
    """Every scan of a folder has its rows; one that cannot be used is said and stops nothing."""
    volume = make_phantom(named_phantom("wavy-13dB-averaged", shape=(9, 48, 24))).volume
    save_volume(tmp_path / "good.nii.gz", volume)
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY rubbish")
    (tmp_path / "deep").mkdir()
    save_volume(tmp_path / "deep" / "another.npz", volume)
    assert [path.name for path in scan_files(tmp_path)] == ["bad.npy", "another.npz", "good.nii.gz"]
    request = BenchmarkRequest(data=tmp_path, device="cpu", workers=1)
    result = sparse.run(request, dataclasses.replace(TINY, factors=(2,)))
    assert [row["volume"] for row in result.rows] == ["deep/another.npz", "good.nii.gz"]
    assert any("bad.npy is left out" in note for note in result.notes)
    assert all("field_truth_psnr_db" in row for row in result.rows)
    (tmp_path / "empty").mkdir()
    with pytest.raises(VolumeError, match="found none"):
        sparse.run(BenchmarkRequest(data=tmp_path / "empty"), TINY)
    with pytest.raises(VolumeError, match="expected a folder"):
        scan_files(tmp_path / "good.nii.gz")


def test_folders_of_images_are_scans(tmp_path):
    """Numbered images in a folder are one scan; a lone TIFF is one of its own; hidden files are none."""
    from PIL import Image

    (tmp_path / "eye").mkdir()
    for number in range(3):
        Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "eye" / f"{number}.png")
    save_volume(tmp_path / "stack.tif", Volume.from_array(np.float32(np.indices((3, 8, 8))[0]), SPACING_M))
    (tmp_path / ".hidden.npy").touch()
    assert scan_files(tmp_path) == [tmp_path / "eye", tmp_path / "stack.tif"]
