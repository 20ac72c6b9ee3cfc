"""Why and when a fit ends: steps, time, target, cancellation; and what it tells meanwhile."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from octn_ros.errors import ConfigurationError
from octn_ros.field import HashGridConfig, InterpolatedField, NetworkConfig, NeuralFieldConfig
from octn_ros.training import PRESETS, FitConfig, ResidentVoxels, VoxelSampler, fit, progress, psnr_of_field
from octn_ros.training.held_in import EVALUATED_VOXELS, HeldInVoxels, evaluated_bscans
from octn_ros.volume import Volume

CONFIG = FitConfig(
    preset="test",
    field=NeuralFieldConfig(HashGridConfig(levels=2, log2_table_size=12, base_resolution=4), NetworkConfig(1, 16)),
    steps=400,
    batch=4096,
)


def blob(shape):
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    return Volume.from_array(np.exp(-2 * sum(a**2 for a in axes)), (28e-6, 14.59e-6, 14e-6))


@pytest.fixture(scope="module")
def volume():
    return blob((20, 24, 28))


class Canceller:
    """Cancels from its n-th question on and counts the batches drawn after that."""

    def __init__(self, monkeypatch, question):
        self.question, self.asked, self.drawn_after = question, 0, 0
        batch = VoxelSampler.batch

        def counted(sampler, *arguments):
            self.drawn_after += self.cancelled
            return batch(sampler, *arguments)

        monkeypatch.setattr(VoxelSampler, "batch", counted)

    @property
    def cancelled(self):
        return self.asked >= self.question

    def __call__(self):
        self.asked += 1
        return self.cancelled


@pytest.mark.parametrize("question", [1, 2, 7, 8])
def test_no_step_begins_after_a_cancel(volume, monkeypatch, question):
    canceller = Canceller(monkeypatch, question)
    result = fit(volume, CONFIG, cancelled=canceller)
    assert canceller.drawn_after == 0
    assert canceller.asked == question, "once cancelled, a fit asks no more and evaluates nothing"
    assert (result.ended, result.steps) == ("cancelled", (question - 1) // 2)
    assert math.isnan(result.psnr_db)


def test_the_evaluation_at_the_end_can_be_cancelled_too(volume, monkeypatch):
    steps = 4
    canceller = Canceller(monkeypatch, 2 * steps + 3)
    result = fit(volume, dataclasses.replace(CONFIG, steps=steps), cancelled=canceller)
    assert canceller.asked == 2 * steps + 3
    assert (result.ended, result.steps) == ("cancelled", steps)
    assert math.isnan(result.psnr_db)
    assert result.field.description.training["psnr_db"] is None


def test_a_target_ends_the_fit_once_it_is_reached(volume):
    whole = fit(volume, CONFIG)
    target = whole.psnr_db - 10.0
    result = fit(volume, dataclasses.replace(CONFIG, target_psnr_db=target))
    assert result.ended == "target"
    assert 0 < result.steps < whole.steps
    assert result.steps % HeldInVoxels.period(CONFIG.batch) == 0
    assert result.history[-1].psnr_db >= target
    assert result.history[-1].step == result.steps
    assert fit(volume, dataclasses.replace(CONFIG, steps=20, target_psnr_db=90.0)).ended == "steps"


def test_progress_is_the_psnr_of_the_held_in_bscans(volume, monkeypatch):
    monkeypatch.setattr(progress, "REPORT_PERIOD_S", 0.0)
    result = fit(volume, CONFIG)
    assert [report.step for report in result.history] == list(range(1, 401))
    # What the last report says of a sample of voxels holds for the whole B-scans; its standard error is about 0.05 dB.
    assert result.history[-1].psnr_db == pytest.approx(result.psnr_db, abs=0.4)
    curve = [report.psnr_db for report in result.history]
    assert curve[-1] > curve[0] + 10
    assert len(set(curve)) <= 400 // HeldInVoxels.period(CONFIG.batch) + 2
    assert all(report.samples_per_s > 0 for report in result.history)


def test_held_in_voxels_are_the_same_ones_and_lie_on_the_evaluated_bscans(volume):
    voxels = ResidentVoxels(volume, torch.device("cpu"))
    first, again = HeldInVoxels(voxels), HeldInVoxels(voxels)
    assert torch.equal(first._points, again._points)
    index = volume.geometry.canonical_to_voxel(first._points.double()).round().long().numpy()
    assert len(index) == EVALUATED_VOXELS
    assert set(index[:, 0]) == set(evaluated_bscans(volume.geometry))
    np.testing.assert_array_equal(first._intensities.numpy(), volume.normalized()[tuple(index.T)])
    assert first.variance == pytest.approx(float(volume.normalized().var()), rel=0.1)


def test_evaluations_cost_little():
    for batch in (256, 1 << 14, 1 << 18):
        # An evaluated voxel costs at most a third of a trained sample.
        assert EVALUATED_VOXELS / 3 / (HeldInVoxels.period(batch) * batch) < 0.02


def test_evaluated_bscans_are_evenly_spaced():
    assert evaluated_bscans(blob((3, 4, 5)).geometry).tolist() == [0, 1, 2]
    assert evaluated_bscans(blob((31, 4, 5)).geometry).tolist() == list(range(0, 31, 2))


def test_psnr_of_a_field_is_that_of_its_voxels(volume):
    field = InterpolatedField(volume)
    shifted = volume.replace_intensity(np.clip(volume.normalized() * 0.5 + 0.25, 0, 1))
    chosen = evaluated_bscans(volume.geometry)
    error = np.mean((shifted.normalized()[chosen].astype(np.float64) - volume.normalized()[chosen]) ** 2)
    assert psnr_of_field(field, shifted) == pytest.approx(-10 * np.log10(error), abs=1e-4)
    assert psnr_of_field(field, volume) > 100
    assert math.isnan(psnr_of_field(field, volume, cancelled=lambda: True))


def test_a_fit_lists_its_settings_as_json_can_hold_them(volume):
    import json

    result = fit(volume, dataclasses.replace(CONFIG, steps=2))
    training = json.loads(json.dumps(result.field.description.training))
    assert training["ended"] == "steps"
    assert training["config"]["field"]["grid"]["levels"] == 2


def test_a_bad_target_is_refused():
    with pytest.raises(ConfigurationError, match="target_psnr_db"):
        dataclasses.replace(PRESETS["fast"], target_psnr_db=-1.0)
