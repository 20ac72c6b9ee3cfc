"""`octn bench compare`: the rivals as published, their fits, judgement worked by hand, and the whole of it."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from octn_ros.errors import TrainingError
from octn_ros.evaluation import compare
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.compare import HeldOutJudge
from octn_ros.evaluation.compare_config import CompareBenchConfig
from octn_ros.evaluation.report import result_to_plain
from octn_ros.evaluation.rival_fields import RIVALS, CuNerfNetwork, Siren
from octn_ros.evaluation.rival_training import fit_rival, render_rival
from octn_ros.evaluation.scans import BenchScan
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import Volume, subsample_bscans

TINY = CompareBenchConfig(
    phantoms=("wavy-13dB-averaged",),
    shape=(9, 48, 16),
    presets=("fast", "sparse"),
    seconds=0.2,
    samples=1 << 13,
    judged_bscans=3,
)


def ramp():
    """A volume that rises along the beam: what any representation can learn."""
    axial = np.linspace(0.1, 0.9, 24, dtype=np.float32)
    return Volume.from_array(np.tile(axial[None, :, None], (5, 1, 12)), (28e-6, 14e-6, 14e-6), intensity_range=(0, 1))


def test_cunerf_by_hand():
    """Ten octaves of sine and cosine of three coordinates; the skip stage only puts the encoding beside."""
    network = CuNerfNetwork()
    widths = [layer.in_features for layer in network.modules() if isinstance(layer, torch.nn.Linear)]
    assert widths == [60, 256, 256, 256, 316, 256, 256, 256]
    assert network.frequencies.tolist() == [2.0**octave for octave in range(10)]
    assert network(torch.zeros(7, 3)).shape == (7,)


def test_siren_is_initialised_as_published():
    """Weights and sines keep a hidden layer's inputs at unit variance, whatever the depth (Sitzmann, theorem 1.8)."""
    torch.manual_seed(0)
    siren = Siren()
    assert [layer.out_features for layer in siren.layers] == [256] * 4 + [1]
    features = torch.rand(4096, 3) * 2 - 1
    for number, layer in enumerate(siren.layers[:-1]):
        before = 30 * layer(features)
        if number:
            assert (before - 30 * layer.bias).std().item() == pytest.approx(1.0, abs=0.15)
        features = torch.sin(before)
        assert features.std().item() == pytest.approx(math.sqrt(0.5), abs=0.1)


@pytest.mark.parametrize("name", sorted(RIVALS))
def test_a_rival_learns(name):
    """On a ramp along the beam each rival comes far above the volume's mean, on the right axis."""
    volume = ramp()
    result = fit_rival(RIVALS[name], volume, device="cpu", seed=0, samples=1 << 16)
    assert result.samples == 1 << 16 == result.steps * RIVALS[name].batch
    rendered = render_rival(result.model, volume.geometry, np.arange(5.0), "cpu")
    assert rendered.shape == (5, 24, 12)
    assert np.sqrt(np.mean(np.square(rendered - volume.normalized()))) < 0.3 * volume.normalized().std()


def test_fits_repeat_and_end_by_the_clock():
    volume, siren = ramp(), RIVALS["siren"]
    state = torch.random.get_rng_state()
    one, two = (fit_rival(siren, volume, device="cpu", seed=3, samples=4096).model for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters(), strict=True))
    assert torch.equal(state, torch.random.get_rng_state())
    timed = fit_rival(siren, volume, device="cpu", seed=3, seconds=0.2)
    assert timed.seconds >= 0.2
    assert timed.samples == timed.steps * siren.batch > 0
    for arguments in ({}, {"seconds": 1.0, "samples": 5}):
        with pytest.raises(TrainingError, match="either seconds or samples"):
            fit_rival(siren, volume, device="cpu", seed=0, **arguments)


def test_figures_by_hand():
    """An error of 0.1 on held-out B-scans alone is 20 dB there and none where the field was fitted."""
    phantom = make_phantom(named_phantom("flat-13dB-averaged", shape=(9, 64, 16)))
    judge = HeldOutJudge(BenchScan("scan", phantom.volume), subsample_bscans(phantom.volume, 2), 16)
    asked = []

    def render(positions):
        asked.append(positions * 2)
        return phantom.volume.normalized(np.int64(positions * 2)) + 0.1 * (positions % 1 > 0)[:, None, None]

    figures = judge.judge(render)
    assert [list(positions) for positions in asked] == [[0, 2, 4, 6, 8], [1, 3, 5, 7]]
    assert figures["fitted_psnr_db"] == math.inf
    assert figures["fitted_ssim"] == pytest.approx(1.0)
    assert figures["held_out_psnr_db"] == pytest.approx(20.0, abs=1e-3)
    assert figures["held_out_ssim"] < 1.0
    assert "held_out_truth_psnr_db" not in figures
    few = HeldOutJudge(BenchScan("scan", phantom.volume, phantom.truth), subsample_bscans(phantom.volume, 2), 2)
    asked.clear()
    assert few.judge(render)["held_out_truth_psnr_db"] < 20.0
    assert [list(positions) for positions in asked] == [[0, 8], [1, 7]]


def test_the_whole_of_it_on_a_tiny_phantom():
    """Rows for either budget, each kept to it; interpolations are perfect where they were given the voxels."""
    told = []
    result = compare.run(BenchmarkRequest(device="cpu", progress=lambda *what: told.append(what)), TINY)
    methods = ["fast", "sparse", "cunerf", "siren"]
    assert [(row["budget"], row["method"]) for row in result.rows] == [
        *(("seconds", method) for method in methods),
        *(("samples", method) for method in methods),
        ("none", "trilinear"),
        ("none", "cubic"),
    ]
    for row in result.rows:
        if row["budget"] == "samples":
            assert 0 < row["samples"] <= TINY.samples
        if row["budget"] == "none":
            assert row["fitted_psnr_db"] > 100
            assert row["parameters"] == 5 * 48 * 16
        assert 0 < row["held_out_psnr_db"] < 60
        assert row["held_out_truth_psnr_db"] is not None
    seconds = {row["method"]: row["seconds"] for row in result.rows if row["budget"] == "seconds"}
    assert min(seconds["cunerf"], seconds["siren"]) >= max(seconds["fast"], seconds["sparse"]) >= 0.2
    papers = {row["method"]: row.get("paper_psnr_db") for row in result.rows}
    assert (papers["cunerf"], papers["fast"], papers["siren"]) == (23.82, 35.09, None)
    assert sum("on held-out B-scans against the" in note for note in result.notes) == 4
    assert list(result.pictures) == ["compare-wavy-13dB-averaged.png"]
    assert told
    json.dumps(result_to_plain(result, {}), allow_nan=False)


def test_the_paper_s_grid_takes_part():
    """24 levels and 2^20 entries a level, with a batch that a CPU can step."""
    fit = compare._fit_config("paper", "samples", dataclasses.replace(TINY, paper_batch=1 << 10))
    assert (fit.field.grid.levels, fit.field.grid.log2_table_size) == (24, 20)
    assert (fit.batch, fit.steps, fit.time_budget_s) == (1 << 10, 8, 0.0)
