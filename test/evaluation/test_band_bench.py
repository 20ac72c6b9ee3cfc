"""`octn bench band`: every way finds the points it should, stages add up, and the whole of it on a tiny phantom."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation import band
from octn_ros.evaluation.band_config import BandBenchConfig
from octn_ros.evaluation.band_timing import middle_of
from octn_ros.evaluation.band_ways import Files, field_exhaustive, field_index, voxels_cpu, voxels_gpu
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.report import result_to_plain
from octn_ros.field import InterpolatedField, save_field
from octn_ros.query import PAPER_BANDS, find_band_exhaustively
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import Volume, save_volume

TINY = BandBenchConfig(phantoms=("wavy-13dB-averaged",), shape=(16, 64, 32), side_m=2.5e-4, steps=20, repeats=1)
VOLUME = make_phantom(named_phantom("wavy-13dB-averaged", shape=(16, 64, 32))).volume


@pytest.fixture
def files(tmp_path):
    found = Files(tmp_path / "volume.nii", tmp_path / "field.safetensors", "cpu")
    save_volume(found.volume, VOLUME)
    save_field(found.field, InterpolatedField(VOLUME))
    return found


@pytest.mark.parametrize("query", PAPER_BANDS)
def test_every_way_finds_the_same_points(files, query):
    """All ways have the answer of the plain reference, on the volume and on the field alike."""
    mask = middle_of(VOLUME.geometry, 2.5e-4)
    voxels, expected = (
        find_band_exhaustively(source, query, mask).points_m for source in (VOLUME, InterpolatedField(VOLUME))
    )
    assert 0 < len(voxels) < 0.5 * VOLUME.array.size
    # Torch runs the GPU's way on the CPU too.
    for way, reference in ((voxels_cpu, voxels), (voxels_gpu, voxels), (field_exhaustive, expected)):
        answer = way(files, query, mask)
        np.testing.assert_allclose(answer.points_m, reference, atol=1e-12, err_msg=way.__name__)
        assert answer.transfer_s is None
        assert answer.query_s == answer.filtering_s + answer.masking_s > 0
        assert answer.total_s == answer.query_s + answer.initialisation_s > answer.query_s
    first, again = field_index(files, query, mask)
    np.testing.assert_array_equal(first.points_m, expected)
    np.testing.assert_array_equal(again.points_m, expected)
    assert first.masking_s is None


def test_bands_share_no_point_and_limits_count_once(tmp_path):
    """Voxels exactly on a limit: 0.4 belongs to the middle band, 0.6 and 1 to the last, in every way."""
    levels = np.float32([0.0, 0.2, 0.4, 0.6, 1.0])
    volume = Volume.from_array(np.tile(levels[None, :, None], (4, 1, 4)), (1e-5,) * 3, intensity_range=(0.0, 1.0))
    files = Files(tmp_path / "volume.nii", tmp_path / "field.safetensors", "cpu")
    save_volume(files.volume, volume)
    save_field(files.field, InterpolatedField(volume))
    mask = middle_of(volume.geometry, 1.0)
    for way in (field_exhaustive, lambda *arguments: field_index(*arguments)[1]):
        assert [len(way(files, query, mask).points_m) for query in PAPER_BANDS] == [16, 16, 32]


def test_unsigned_voxels_of_16_bits(tmp_path):
    """Torch compares them on no GPU; the way of the GPU finds the same all the same."""
    volume = dataclasses.replace(
        VOLUME, array=np.uint16(VOLUME.normalized() * 60000), intensity_range=(0.0, 60000.0)
    )  # fmt: skip
    files = Files(tmp_path / "volume.nii", tmp_path / "none", "cpu")
    save_volume(files.volume, volume)
    mask = middle_of(volume.geometry, 1.0)
    one, other = (way(files, PAPER_BANDS[0], mask).points_m for way in (voxels_cpu, voxels_gpu))
    np.testing.assert_array_equal(one, other)
    assert len(one)


def test_points_that_differ_are_counted():
    points = np.arange(12.0).reshape(4, 3)
    assert band._different(points, points.copy()) == 0
    assert band._different(points, points[1:]) == 1
    assert band._different(points[:3], points[1:]) == 2


def test_the_whole_of_it_on_a_tiny_phantom(monkeypatch):
    """A row for every band and way, ratios to the CPU's, Chamfer where it belongs, the paper's figures beside it."""
    told = []
    result = band.run(BenchmarkRequest(device="cpu", progress=lambda *what: told.append(what)), TINY)
    ways = (band.CPU, band.EXHAUSTIVE, band.FIRST, band.REPEATED)
    assert [(row["band"], row["way"]) for row in result.rows] == [
        (name, way) for name in ("[0.2, 0.4)", "[0.4, 0.6)", "[0.6, 1]") for way in ways
    ]
    for row in result.rows:
        cpu = next(each for each in result.rows if (each["band"], each["way"]) == (row["band"], band.CPU))
        assert row["ratio_total_cpu"] == pytest.approx(cpu["total_s"] / row["total_s"])
        assert row["total_s"] > row["initialisation_s"] > 0
    fields = [row for row in result.rows if row["way"] == band.EXHAUSTIVE]
    assert [row["paper_chamfer_mm"] for row in fields] == [0.0423, 0.0264, 0.0158]
    assert all(0 < row["chamfer_mm"] < row["hausdorff_mm"] < 1 for row in fields if "chamfer_mm" in row)
    assert any("chamfer_mm" in row and "truth_chamfer_mm" in row for row in fields)
    assert not any("not the same with index and without" in note for note in result.notes)
    assert any("no GPU" in sentence for sentence in result.deviations) or torch.cuda.is_available()
    (picture,) = result.pictures.values()
    assert picture.startswith(b"\x89PNG")
    assert told
    json.dumps(result_to_plain(result, {}), allow_nan=False)


def test_a_preset_that_is_none():
    with pytest.raises(ConfigurationError, match="expected one of"):
        band.run(BenchmarkRequest(device="cpu"), dataclasses.replace(TINY, preset="magic"))
