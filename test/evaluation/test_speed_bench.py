"""`octn bench speed`: its arithmetic by hand, torch.compile's steps against plain torch, and the whole of it, tiny."""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.report import result_to_plain
from octn_ros.evaluation.speed import headline, run
from octn_ros.evaluation.speed_config import SpeedBenchConfig
from octn_ros.evaluation.speed_curves import Curve, CurvePoint, all_bscans, curve, volume_psnr, yardstick
from octn_ros.evaluation.speed_queries import AXIS_BY_AXIS
from octn_ros.evaluation.speed_samples import between_rows
from octn_ros.evaluation.speed_sizes import SizeCost
from octn_ros.evaluation.speed_trainers import CompiledTorchTrainer, make_stepper, samples_per_s, start_model
from octn_ros.simulation import make_phantom
from octn_ros.volume import Volume

TINY = SpeedBenchConfig(
    shape=(16, 40, 32),
    full_shape=(16, 160, 64),
    samples_shape=(16, 40, 32),
    budgets_s=(0.3,),
    full_budget_s=0.3,
    rate_s=0.05,
    samples=1 << 15,
    divisors=(1,),
    ways=("eager", "fused"),
    full_ways=("fused",),
    thorough=False,
    batch=1 << 12,
    hybrid_share=1.0,
    region_side_m=3e-4,
    raster_side_m=0.3e-3,
    raster_fit_s=0.2,
    repeats=1,
)
ISSUE_KEYS = {
    "seconds_to_gaussian_truth", "quality_ratio_eager", "train_ratio_eager", "lattice_mpoints_s",
    "lattice_ratio_eager", "seconds_to_30db", "band_ratio_lattice", "band_ratio_numpy", "raster_ratio_knn", "peak_gb",
}  # fmt: skip


def made_curve(way, start, reached_s, budget_s=60.0):
    point = CurvePoint(reached_s, 100, 43.0, 31.0)
    return Curve(way, start, (point,), budget_s, 0.0, reached_s)


def test_ratios_by_hand_and_lower_bounds_told():
    curves = [
        made_curve("fused", "data", 0.5),
        made_curve("compile", "data", 1.0),
        made_curve("eager", "data", 2.0),
        made_curve("fused", "mean", 5.0),
        made_curve("compile", "mean", 20.0),
        made_curve("eager", "mean", math.nan),
    ]
    cost = SizeCost(0.7, 0, 31.0, 47.0, 2.0, 0.05, 1.5, "compiled")
    place = {"phantom": "256x512x512", "field": "fast"}
    rows = [
        {"part": "rate", "way": "eager", "msamples_s": 0.5, "fused_over_this": 24.0, **place},
        {"part": "rate", "way": "compile", "msamples_s": 2.0, "fused_over_this": 6.0, **place},
        {"part": "rate", "way": "fused", "msamples_s": 12.0, "fused_over_this": 1.0, **place},
        {"part": "rate", "way": "eager", "msamples_s": 6.0, "fused_over_this": 2.0, **place, "phantom": "128x160x256"},
        {"part": "rate", "way": "eager", "msamples_s": 1.0, "fused_over_this": 8.0, **place, "field": "many levels"},
        {"part": "lattice", "way": "fused", "mpoints_s": 20.0, "fused_over_this": 1.0},
        {"part": "lattice", "way": "eager", "mpoints_s": 0.5, "fused_over_this": 40.0},
        {"part": "lattice", "way": AXIS_BY_AXIS, "mpoints_s": 5.0, "fused_over_this": 4.0},
        {"part": "band", "band_ratio_lattice": 9.0, "band_ratio_numpy": 0.7},
        {"part": "band", "band_ratio_lattice": 7.0, "band_ratio_numpy": 0.9},
        {"part": "raster", "way": "newton", "raster_ratio_knn": 6.0},
    ]  # fmt: skip
    figures = headline(SpeedBenchConfig(), curves, cost, rows)
    assert figures["seconds_to_gaussian_truth"] == 0.5
    assert (figures["quality_ratio_eager"], figures["quality_ratio_eager_is_lower_bound"]) == (120.0, True)
    assert (figures["quality_ratio_compile"], figures["quality_ratio_compile_is_lower_bound"]) == (40.0, False)
    assert figures["quality_ratio_eager_same_preset"] == 4.0
    assert figures["quality_ratio_compile_from_mean"] == 4.0
    assert (figures["train_ratio_eager"], figures["train_ratio_compile"]) == (24.0, 6.0)
    assert (figures["train_ratio_eager_many_levels"], figures["train_msamples_s"]) == (8.0, 12.0)
    assert (figures["lattice_ratio_eager"], figures["lattice_ratio_eager_axis_by_axis"]) == (40.0, 4.0)
    assert (figures["band_ratio_lattice"], figures["band_ratio_numpy"]) == (7.0, 0.7)
    assert (figures["seconds_to_30db"], figures["peak_gb"]) == (0.7, 1.5)
    worse = dataclasses.replace(cost, noisy_db=29.9)
    assert math.isnan(headline(SpeedBenchConfig(), curves, worse, rows)["seconds_to_30db"])


def test_psnr_of_volumes_by_hand():
    ramp = np.linspace(0.0, 0.8, 256, dtype=np.float32).reshape(4, 8, 8)
    one, other = (
        Volume.from_array(array, (1e-5,) * 3, intensity_range=(0.0, 1.0)) for array in (ramp, ramp + np.float32(0.1))
    )
    assert volume_psnr(one, other, all_bscans(one)) == pytest.approx(20.0, abs=1e-4)


def test_a_phantom_half_a_bscan_further_is_the_truth_between():
    """What `between_rows` compares with: on the smooth tissue, close to the mean of the two neighbours."""
    against = yardstick((16, 40, 32), seed=100)
    config = against.phantom.config
    moved = make_phantom(dataclasses.replace(config, shift_m=(0.0, -0.5 * config.spacing_m[0], 0.0))).truth.normalized()
    truth = against.phantom.truth.normalized()
    there = np.square(0.5 * (truth[1:] + truth[:-1]) - moved[:-1]).mean()
    beside = np.square(truth[:-1] - moved[:-1]).mean()
    assert there < 0.2 * beside


def test_a_start_from_the_data_does_not_pay_between_the_bscans():
    against = yardstick((16, 80, 64), seed=100)
    config = dataclasses.replace(TINY, samples=1 << 17)
    rows = {(row["way"], row["start"]): row for row in between_rows(config, against, "cpu")}
    data, mean = rows["fused", "data"], rows["fused", "mean"]
    assert data["psnr_fraction_db"] > data["psnr_truth_db"] - 0.5
    for key in ("psnr_truth_db", "psnr_fraction_db", "psnr_held_out_db"):
        assert data[key] > mean[key]
    assert rows["gaussian", ""]["psnr_fraction_db"] == pytest.approx(rows["gaussian", ""]["psnr_truth_db"], abs=0.5)


def test_the_clock_of_a_curve_leaves_looking_out():
    against = yardstick((16, 40, 32), seed=100)
    drawn = curve("fused", "mean", TINY.fit_config("mean"), against, "cpu", 0.4, stop_when_reached=False)
    seconds = [point.seconds for point in drawn.points]
    assert seconds == sorted(seconds)
    assert 0.4 <= seconds[-1] < 1.5
    assert drawn.points[0].samples == 0 < drawn.points[-1].samples
    assert drawn.points[-1].truth_db > drawn.points[0].truth_db + 3.0


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
# torch.compile's own code uses what torch has deprecated.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_compiled_torch_learns_what_plain_torch_does():
    volume = yardstick((16, 40, 32), seed=100).phantom.volume
    settings = TINY.fit_config("mean")
    losses = {}
    for way in ("eager", "compile"):
        began = start_model(volume, settings, "cpu")
        stepper = make_stepper(way, began, volume, settings)
        assert isinstance(stepper, CompiledTorchTrainer) == (way == "compile")
        losses[way] = [float(stepper.step(1e-2, 0.2, lambda: False)) for _ in range(40)]
        assert samples_per_s(stepper, settings, 0.05) > 0
    assert np.mean(losses["compile"][-5:]) == pytest.approx(np.mean(losses["eager"][-5:]), rel=0.25)
    assert losses["compile"][-1] < 0.2 * losses["compile"][0]


def test_scans_without_truth_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="no known truth"):
        run(BenchmarkRequest(data=tmp_path), TINY)


def test_the_whole_of_it_on_a_tiny_configuration():
    told = []
    result = run(BenchmarkRequest(device="cpu", progress=lambda *what: told.append(what)), TINY)
    plain = json.loads(json.dumps(result_to_plain(result, {}), allow_nan=False))
    assert set(plain) >= ISSUE_KEYS
    assert all(plain["figures"][key] == plain[key] for key in ISSUE_KEYS)
    assert plain["seconds_to_30db"] is None or plain["psnr_noisy_db"] >= TINY.target_db
    assert 0.05 < plain["peak_gb"] < 4.0
    assert plain["train_ratio_eager"] > 1.0
    parts = {row["part"] for row in plain["rows"]}
    assert parts == {"quality", "curve", "30 dB", "rate", "lattice", "band", "raster", "samples", "between"}
    assert set(result.pictures) == {"speed-psnr.png", "speed-samples.png"}
    assert all(content.startswith(b"\x89PNG") for content in result.pictures.values())
    assert told[-1][1] <= 1.0


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_quick_run_has_every_figure():
    figures = run(BenchmarkRequest(device="cpu", quick=True)).figures
    assert set(figures) >= {*ISSUE_KEYS, "quality_ratio_compile", "train_ratio_compile"}
