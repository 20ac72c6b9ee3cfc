"""`octn bench raster`: its judgement worked by hand, and the whole of it on a tiny phantom."""

import json
import math

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.raster import PAPER, centred_raster, offset_notes, run
from octn_ros.evaluation.raster_config import QUICK, SYSTEM, RasterBenchConfig
from octn_ros.evaluation.raster_fields import FILTERS, filtered, phantom_config
from octn_ros.evaluation.raster_judgement import Judge
from octn_ros.evaluation.raster_methods import BASELINE, DESCENDED, DESCENTS, methods
from octn_ros.evaluation.raster_timing import TimeRatios, Timing, time_ratios
from octn_ros.evaluation.report import result_to_plain
from octn_ros.field import InterpolatedField
from octn_ros.planning import GiveUp, RasterPattern, SurfaceSearch
from octn_ros.simulation import NAMED_PHANTOMS, make_phantom, named_phantom

TINY = RasterBenchConfig(
    phantoms=("flat-13dB-single-look",),
    phantoms_fitted=(),
    phantoms_in_full=("flat-13dB-single-look",),
    bscans=32,
    laterals=64,
    side_m=0.4e-3,
    fit_s=0.3,
    descent_steps=3,
    timing_shape=(16, 160, 64),
    timing_side_m=0.3e-3,
)


def search(depth_m, tau, intensity, given_up, correction_m=0.0):
    count = len(depth_m)
    intensity = np.where(given_up, np.nan, intensity)
    return SurfaceSearch(
        depth_m=np.where(given_up, np.nan, depth_m),
        intensity=intensity,
        residual=intensity - tau,
        confidence=np.ones(count),
        given_up=given_up,
        reason=np.where(given_up, GiveUp.FLAT, GiveUp.KEPT).astype(np.int8),
        tau=np.full(count, tau),
        coarse_depth_m=depth_m,
        offset_correction_m=correction_m,
        method="made by hand",
        seconds={"refine": 0.0},
    )


@pytest.fixture(scope="module")
def flat():
    return make_phantom(named_phantom("flat-13dB-single-look", shape=(16, 160, 32)))


def judge(phantom, baseline_um):
    """Two lines of four waypoints over a flat surface; the baseline lies `baseline_um` below it."""
    x, y = np.meshgrid(0.1e-3 + 50e-6 * np.arange(4), [0.1e-3, 0.15e-3])
    pattern = RasterPattern(np.column_stack([x.ravel(), y.ravel()]), np.repeat(np.arange(2, dtype=np.int32), 4))
    surface_m = phantom.surface_depth_m(x.ravel(), y.ravel())
    baseline = search(surface_m + np.asarray(baseline_um) * 1e-6, 0.4, np.full(8, 0.4), np.zeros(8, dtype=bool))
    return Judge(phantom, InterpolatedField(phantom.truth), pattern, baseline), surface_m


def test_one_row_by_hand(flat):
    # The baseline's first line runs 0, 10, 0, 0 um: second differences -20, 10; the second line 0, 0, 0, 0.
    held, surface_m = judge(flat, [0, 10, 0, 0, 0, 0, 0, 0])
    # Ours lies 3, 3, 1, 3 um and 3, 3, given up, 11 um below the surface: the median of the seven is 3, the squares
    # about it 4 and 64, the largest distance 11. In the first line the second differences are -2 and 4, in the second
    # no triple is left. Intensities: 0.4 (hit), 0.42 (hit: exactly 5 %), 0.43 (miss), the rest hits.
    depth = surface_m + np.array([3, 3, 1, 3, 3, 3, 0, 11]) * 1e-6
    intensity = np.array([0.4, 0.42, 0.43, 0.4, 0.4, 0.4, 0.4, 0.4])
    given_up = np.arange(8) == 6
    row = held.row(search(depth, 0.4, intensity, given_up))
    assert row["hit_rate"] == pytest.approx(6 / 8)
    assert row["given_up"] == pytest.approx(1 / 8)
    assert row["kept_outside_artefacts"] == pytest.approx(7 / 8)
    assert row["offset_um"] == pytest.approx(3.0, abs=1e-3)
    assert row["spread_um"] == pytest.approx(np.sqrt(68 / 7), abs=1e-3)
    assert row["max_um"] == pytest.approx(11.0, abs=1e-3)
    assert row["smoothness_mm2"] == pytest.approx((2e-3) ** 2 + (4e-3) ** 2, rel=1e-3)
    assert row["smoothness_ratio"] == pytest.approx((4 + 16) / (400 + 100), rel=1e-3)
    assert row["true_smoothness_ratio"] == pytest.approx(0.0, abs=1e-9)


def test_the_truth_judges_intensity_at_the_level_set_not_at_the_corrected_depth(flat):
    held, surface_m = judge(flat, [0, 10, 0, 0, 0, 0, 0, 0])
    z = round(float(surface_m[0]) / flat.truth.geometry.spacing_m[1])
    tau = float(flat.truth.array[8, z, 16])
    depth = np.full(8, z * flat.truth.geometry.spacing_m[1])
    everywhere = np.zeros(8, dtype=bool)
    plain = held.row(search(depth, tau, np.full(8, tau), everywhere))
    corrected = held.row(search(depth + 40e-6, tau, np.full(8, tau), everywhere, correction_m=40e-6))
    assert plain["hit_rate_truth"] == corrected["hit_rate_truth"] == 1.0
    assert corrected["offset_um"] == pytest.approx(plain["offset_um"] + 40.0, abs=1e-3)
    assert held.row(search(depth + 40e-6, tau, np.full(8, tau), everywhere))["hit_rate_truth"] < 1.0


def test_nothing_kept_is_a_row_without_distances(flat):
    held, surface_m = judge(flat, [0, 10, 0, 0, 0, 0, 0, 0])
    row = held.row(search(surface_m, 0.4, np.full(8, 0.4), np.ones(8, dtype=bool)))
    assert (row["hit_rate"], row["given_up"]) == (0.0, 1.0)
    assert np.isnan([row["spread_um"], row["offset_um"], row["max_um"], row["smoothness_ratio"]]).all()


def test_the_raster_lies_in_the_middle(flat):
    pattern = centred_raster(flat.volume.geometry, 0.2e-3, 50e-6)
    middle = np.array(flat.volume.geometry.extent_m[:2]) / 2
    np.testing.assert_allclose(pattern.points_m.mean(axis=0), middle, atol=1e-12)
    assert len(pattern.points_m) == 25


def test_filters_have_names(flat):
    assert filtered(flat.volume, "raw").volume is flat.volume
    spread = [float(np.std(filtered(flat.volume, name).volume.normalized())) for name in FILTERS]
    assert all(value < spread[0] for value in spread[1:])


def test_offsets_of_one_system_are_compared():
    rows = [
        {"phantom": f"{name}-13dB-single-look", "field": "f", "method": "newton", "offset_um": offset}
        for name, offset in (("flat", -9.0), ("tilted30", -12.5), ("glare", 40.0))
    ]
    (note,) = offset_notes(rows)
    assert "a range of 3.5 um" in note


def test_gradient_descent_where_it_is_waited_for(flat):
    config = RasterBenchConfig(descent_steps=3)
    field, pattern = InterpolatedField(flat.volume), centred_raster(flat.volume.geometry, 0.2e-3, 50e-6)
    for name in ("sgd", "paper-sgd"):
        assert "3 steps" in methods(config, DESCENTS)[name](field, pattern).method


def test_time_ratios_by_hand():
    # (filter, core, check, warm) in seconds.
    ratios = time_ratios(
        {
            ("voxels-raw", BASELINE): Timing(0.0, 6.0, 0.0, 0.5),
            ("voxels-gaussian", BASELINE): Timing(3.0, 6.0, 0.0, 0.5),
            ("interpolated-raw", "newton"): Timing(0.0, 2.0, 1.0, 2.0),
            ("interpolated-gaussian", "newton"): Timing(3.0, 1.5, 1.5, 1.5),
            ("neural-raw-torch", "newton"): Timing(0.0, 1.5, 0.5, 1.5),
        }
    )
    assert ratios["voxels-gaussian", BASELINE] == TimeRatios(1.0, 1.0, 1.0, 1.0)
    raw = ratios["interpolated-raw", "newton"]
    assert (raw.same_voxels, raw.with_check, raw.warm) == (3.0, 2.0, 0.25)
    assert math.isnan(raw.filtered_baseline)  # that field does need the filter
    smooth = ratios["interpolated-gaussian", "newton"]
    assert (smooth.same_voxels, smooth.filtered_baseline, smooth.with_check) == (2.0, 2.0, 1.5)
    neural = ratios["neural-raw-torch", "newton"]
    assert (neural.same_voxels, neural.filtered_baseline, neural.with_check) == (4.0, 6.0, 3.0)


def test_what_runs_on_which_phantom():
    config = RasterBenchConfig()
    assert set(config.phantoms_in_full) <= set(config.phantoms_fitted) <= set(config.phantoms)
    assert {f"{tissue}-13dB-single-look" for tissue in NAMED_PHANTOMS} == set(config.phantoms_fitted)
    made = phantom_config("glare-13dB-single-look", config)
    assert (made.seed, made.tissue_seed) == (config.seed, config.seed)
    assert config.seed >= 100


def test_the_whole_table_on_a_tiny_phantom():
    told = []
    result = run(BenchmarkRequest(device="cpu", progress=lambda *what: told.append(what)), TINY)
    plain = json.loads(json.dumps(result_to_plain(result, {}), allow_nan=False))
    keys = {"phantom", "field", "method", "hit_rate", "hit_rate_truth", "given_up", "spread_um", "offset_um", "max_um"}
    keys |= {"smoothness_ratio", "true_smoothness_ratio", "kept_outside_artefacts", "time_ratio", "time_ratio_warm"}
    keys |= {"time_ratio_filtered", "time_ratio_with_check"}
    assert all(keys <= set(row) for row in plain["rows"])
    done = {(row["field"], row["method"]): row for row in plain["rows"] if row["phantom"] == TINY.phantoms[0]}
    fields = {f"{kind}-{name}" for kind in ("neural", "interpolated") for name in FILTERS} | {"cubic-gaussian"}
    assert {f for f, _ in done} == fields | {f"voxels-{name}" for name in FILTERS}
    for field in fields:
        assert {"newton", "least_squares", "paper-newton"} <= {m for f, m in done if f == field}
    assert {f for f, m in done if m == "paper-sgd"} == {f for f, m in done if m == "sgd"} == set(DESCENDED)
    newton = done["interpolated-gaussian", "newton"]
    assert newton["hit_rate"] > 0.9
    assert newton["spread_um"] < 7.3
    assert newton["paper_hit_rate"] == PAPER["newton"]["hit_rate"]
    assert newton["time_ratio"] > 0
    assert done["voxels-raw", "baseline"]["time_ratio"] == 1.0
    timed = {(row["field"], row["method"]): row for row in plain["rows"] if "16x160x64" in row["phantom"]}
    assert sorted(f.removesuffix("-compiled") for f, m in timed if m == "paper-sgd") == sorted(DESCENDED)
    assert {"neural-raw-torch", "neural-gaussian-torch"} <= {f for f, _ in timed}
    assert all(row["time_ratio_with_check"] <= row["time_ratio"] for row in timed.values())
    assert plain["configuration"]["bench"]["side_m"] == TINY.side_m
    assert result.pictures["raster-flat-13dB-single-look.png"].startswith(b"\x89PNG")
    assert told[-1][1] <= 1.0


def test_scans_without_truth_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="no known surface"):
        run(BenchmarkRequest(data=tmp_path), TINY)


@pytest.mark.slow
def test_the_quick_run_ends():
    result = run(BenchmarkRequest(device="cpu", quick=True))
    timed = f"wavy{SYSTEM}-64x160x192"
    assert {row["phantom"] for row in result.rows} == {*QUICK.phantoms, timed}
    assert {row["field"] for row in result.rows if row["phantom"] != timed} >= {"neural-raw", "interpolated-gaussian"}
