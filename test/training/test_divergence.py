"""Fits that go wrong: noticed, reported, and the last good state returned."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from octn_ros.errors import TrainingError
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.training import FitConfig, VoxelSampler, fit
from octn_ros.training.divergence import EXPLODED, PATIENCE_STEPS, SNAPSHOT_PERIOD_STEPS, DivergenceGuard
from octn_ros.volume import Volume

CONFIG = FitConfig(
    preset="test",
    field=NeuralFieldConfig(HashGridConfig(levels=2, log2_table_size=10, base_resolution=4), NetworkConfig(1, 16)),
    steps=400,
    batch=4096,
)
PERIOD_STEPS = 80  # of the evaluations, with this batch


@pytest.fixture(scope="module")
def volume():
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in (10, 12, 14)), indexing="ij")
    return Volume.from_array(np.exp(-2 * sum(a**2 for a in axes)), (28e-6, 14.59e-6, 14e-6))


def spoil(monkeypatch, from_batch, value):
    """Add `value` to the intensities of every batch from that one on, counted from 1."""
    batch, count = VoxelSampler.batch, iter(range(1, 10_000))

    def spoilt(self, *arguments):
        points, intensities = batch(self, *arguments)
        return points, intensities + value if next(count) >= from_batch else intensities

    monkeypatch.setattr(VoxelSampler, "batch", spoilt)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e20])
def test_a_loss_that_is_not_finite_ends_the_fit_with_the_last_good_state(volume, monkeypatch, value):
    spoil(monkeypatch, PERIOD_STEPS + 5, value)
    result = fit(volume, CONFIG)
    assert (result.ended, result.steps) == ("diverged", PERIOD_STEPS)
    assert result.psnr_db > 25
    assert result.field.description.training["ended"] == "diverged"
    assert all(bool(torch.isfinite(p).all()) for p in result.field.model.parameters())
    assert all(math.isfinite(report.loss) for report in result.history)


def test_a_loss_that_explodes_and_stays_up_ends_the_fit(volume, monkeypatch):
    spoil(monkeypatch, PERIOD_STEPS + 5, 1e4)
    result = fit(volume, CONFIG)
    assert (result.ended, result.steps) == ("diverged", PERIOD_STEPS)


def test_without_a_good_state_there_is_no_field(volume, monkeypatch):
    spoil(monkeypatch, 1, math.nan)
    with pytest.raises(TrainingError, match=r"step 1 .* lower the learning rate 0\.01"):
        fit(volume, CONFIG)


def test_parameters_spoilt_by_the_last_step_are_found_out(volume, monkeypatch):
    step = torch.optim.Adam.step
    count = iter(range(1, 10_000))

    def spoilt(self, *arguments):
        step(self, *arguments)
        if next(count) == PERIOD_STEPS + 5:
            with torch.no_grad():
                self.param_groups[0]["params"][0].fill_(math.nan)

    monkeypatch.setattr(torch.optim.Adam, "step", spoilt)
    result = fit(volume, dataclasses.replace(CONFIG, steps=PERIOD_STEPS + 5))
    assert (result.ended, result.steps) == ("diverged", PERIOD_STEPS)


def test_a_start_field_is_a_good_state(volume, monkeypatch):
    start = fit(volume, dataclasses.replace(CONFIG, steps=60)).field
    spoil(monkeypatch, 1, math.nan)
    result = fit(volume, CONFIG, start=start)
    assert (result.ended, result.steps) == ("diverged", 0)
    assert torch.equal(result.field.model.grid.table, start.model.grid.table)


def test_the_guard_forgives_a_leap_and_copies_now_and_then():
    model = NeuralModel(CONFIG.field, (10, 12, 14))
    guard = DivergenceGuard(model, variance=0.04)
    assert guard.restore() is None
    leap = 0.04 * EXPLODED * 2
    for _ in range(3):
        assert not any(guard.diverged(leap) for _ in range(PATIENCE_STEPS - 1))
        assert not guard.diverged(0.01)
    assert [guard.diverged(leap) for _ in range(PATIENCE_STEPS)][-1]

    guard.keep(10, 0.05)  # no better than a constant
    assert guard.restore() is None
    before = model.grid.table.detach().clone()
    guard.keep(20, 0.03)
    with torch.no_grad():
        model.grid.table.fill_(7.0)
    guard.keep(21, 0.03)  # too soon after the last copy
    assert guard.restore() == 20
    assert torch.equal(model.grid.table, before)
    guard.keep(20 + SNAPSHOT_PERIOD_STEPS, 0.03)
    assert guard.restore() == 20 + SNAPSHOT_PERIOD_STEPS
