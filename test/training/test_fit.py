import dataclasses
import itertools
import types

import numpy as np
import pytest
import torch

from octn_ros.errors import ConfigurationError, TrainingError
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.training import PRESETS, FitConfig, ResidentVoxels, VoxelSampler, fit, progress, psnr_of_field
from octn_ros.volume import Volume

SMALL = FitConfig(
    preset="test",
    field=NeuralFieldConfig(
        HashGridConfig(levels=3, features=4, log2_table_size=14, base_resolution=4, finest_ratio=0.5),
        NetworkConfig(1, 16),
    ),
    steps=150,
    batch=2048,
)


@pytest.fixture(scope="module")
def volume():
    """A smooth blob, which a small field can represent."""
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in (16, 20, 24)), indexing="ij")
    blob = np.exp(-2 * (axes[0] ** 2 + (axes[1] - 0.3) ** 2 + axes[2] ** 2))
    return Volume.from_array(blob, (28e-6, 14.59e-6, 14e-6), stamp_ns=11)


def sampler_of(volume):
    return VoxelSampler(ResidentVoxels(volume, torch.device("cpu")), 0)


def test_discrete_samples_are_voxels(volume):
    points, intensities = sampler_of(volume).discrete(1000)
    index = volume.geometry.canonical_to_voxel(points.double().numpy())
    rounded = np.round(index).astype(int)
    np.testing.assert_allclose(index, rounded, atol=1e-5)
    np.testing.assert_array_equal(volume.normalized()[tuple(rounded.T)], intensities.numpy())
    assert (np.ptp(rounded, axis=0) == np.array(volume.geometry.shape) - 1).all()


def test_interpolated_samples_fill_the_cube(volume):
    points, intensities = sampler_of(volume).interpolated(4000)
    assert points.abs().max() <= 1
    assert points.mean(0).abs().max() < 0.05
    assert intensities.min() >= 0
    index = volume.geometry.canonical_to_voxel(points)
    assert ((index - index.round()).abs() > 0.05).any(-1).float().mean() > 0.9


def test_a_batch_has_the_share_that_algorithm_1_asks_for(volume):
    sampler = sampler_of(volume)
    for share, voxels in ((0.2009, 800), (0.0, 1000), (1.0, 0), (0.29, 710)):
        points, intensities = sampler.batch(1000, share)
        assert (len(points), len(intensities)) == (1000, 1000)
        index = volume.geometry.canonical_to_voxel(points.double())
        on_grid = ((index - index.round()).abs() < 1e-4).all(-1)
        assert on_grid[:voxels].all()
        assert not on_grid[voxels:].any()


def test_a_fit_reaches_the_volume(volume):
    reports = []
    result = fit(volume, SMALL, progress=reports.append)
    assert result.psnr_db > 35
    assert result.psnr_db == pytest.approx(psnr_of_field(result.field, volume))
    assert (result.steps, result.ended, result.cancelled) == (150, "steps", False)
    assert tuple(reports) == result.history
    assert reports[-1].step == 150
    assert reports[-1].stage == "discrete"
    assert reports[-1].fraction == 1.0
    training = result.field.description.training
    assert training["config"]["alpha"] == 0.2
    assert training["psnr_db"] == result.psnr_db
    assert result.field.description.stamp_ns == 11


def test_the_same_seed_gives_the_same_field(volume):
    quick = dataclasses.replace(SMALL, steps=10)
    torch.manual_seed(1)
    first = fit(volume, quick).field.model.state_dict()
    torch.manual_seed(2)
    state = torch.get_rng_state()
    again = fit(volume, quick).field.model.state_dict()
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(first[name], again[name]) for name in first)
    other = fit(volume, dataclasses.replace(quick, seed=5)).field.model.state_dict()
    assert not torch.equal(first["grid.table"], other["grid.table"])


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_field_with_any_number_of_threads(volume, threads):
    # Large enough for torch to split the work; one number of threads is not held against another.
    config = dataclasses.replace(SMALL, steps=2, batch=1 << 15)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        fields = [fit(volume, config).field.model.state_dict() for _ in range(2)]
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(fields[0][name], fields[1][name]) for name in fields[0])


def test_a_fit_can_be_cancelled(volume):
    asked = iter([False] * 6 + [True])  # twice in every step
    result = fit(volume, SMALL, cancelled=lambda: next(asked))
    assert result.cancelled
    assert result.steps == 3
    assert result.field.description.training["ended"] == "cancelled"
    assert result.field.description.training["psnr_db"] is None


def test_a_time_budget_ends_the_fit_and_both_stages_share_it(volume, monkeypatch):
    # By a clock of its own, 10 ms at each look: a busy machine may take the whole budget for one step.
    clock = itertools.count()
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(perf_counter=lambda: 0.01 * next(clock)))
    config = dataclasses.replace(SMALL, steps=10_000_000, time_budget_s=2.0)
    result = fit(volume, config)
    assert result.steps < config.steps
    assert result.ended == "time"
    seconds = {stage: [r.seconds for r in result.history if r.stage == stage] for stage in ("hybrid", "discrete")}
    assert 0.7 < max(seconds["hybrid"]) < min(seconds["discrete"]) < 1.3
    assert 1.7 < max(seconds["discrete"]) < 2.1


def test_divergence_is_caught(volume):
    with pytest.raises(TrainingError, match="learning rate"):
        fit(volume, dataclasses.replace(SMALL, learning_rate=1.0, final_rate_ratio=1.0, steps=1), cancelled=_poison())


def _poison():
    """Make the next random parameters infinite, so that the first loss is not finite."""
    original = torch.nn.Linear.forward

    def forward(self, inputs):
        torch.nn.Linear.forward = original
        return original(self, inputs) * float("inf")

    def asked():
        torch.nn.Linear.forward = forward
        return False

    return asked


def test_interpolated_samples_only_and_none(volume):
    for alpha in (0.0, 1.0):
        config = dataclasses.replace(SMALL, alpha=alpha, hybrid_share=1.0, steps=3)
        assert fit(volume, config).steps == 3


def test_presets():
    paper = PRESETS["paper"]
    assert (paper.field.grid.levels, paper.field.grid.features, paper.field.grid.log2_table_size) == (24, 2, 20)
    assert (paper.field.grid.base_resolution, paper.field.network.hidden_layers) == (16, 3)
    assert (paper.field.network.neurons, paper.alpha) == (128, 0.20)
    assert PRESETS["fast"].alpha == 0.20
    assert all(name == config.preset for name, config in PRESETS.items())


@pytest.mark.parametrize(
    "wrong", [{"alpha": 1.5}, {"alpha": float("nan")}, {"steps": 0}, {"batch": 64, "alpha": 0.01}, {"seed": -1}]
)
def test_bad_settings_are_refused(wrong):
    with pytest.raises(ConfigurationError):
        dataclasses.replace(SMALL, **wrong)
