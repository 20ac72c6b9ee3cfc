"""The fit against Algorithm 1 of the paper, walked line by line with the same random numbers."""

import dataclasses
import importlib
import math

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.training import PRESETS, FitConfig, VoxelSampler, fit, progress
from octn_ros.volume import Volume

SHAPE = (7, 12, 10)
# The paper's model, made small; what Algorithm 1 says stays as in the preset.
CONFIG = dataclasses.replace(
    PRESETS["paper"],
    field=NeuralFieldConfig(
        HashGridConfig(levels=3, features=2, log2_table_size=10, base_resolution=4), NetworkConfig(2, 16)
    ),
    steps=11,
    batch=333,
    alpha=0.23,
    hybrid_share=0.6,
)


@pytest.fixture(scope="module")
def volume():
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij")
    noise = np.random.default_rng(0).normal(0, 0.05, SHAPE)
    voxels = np.clip(np.exp(-2 * (axes[0] ** 2 + axes[1] ** 2)) + noise, 0, 1)
    return Volume.from_array((voxels * 65535).astype(np.uint16), (28e-6, 14e-6, 14e-6))


def algorithm_1(volume: Volume, config: FitConfig, model: NeuralModel):
    """Walk the listing of the paper; yield (stage, points, intensities, loss, learning rate) of each iteration t."""
    voxels = volume.array.astype(np.float64) / 65535.0
    canonical = [2.0 * np.arange(n) / (n - 1) - 1.0 for n in voxels.shape]
    trilinear = RegularGridInterpolator(canonical, voxels)
    generator = torch.Generator().manual_seed(config.seed)
    first = {name: torch.zeros_like(p) for name, p in model.named_parameters()}
    second = {name: torch.zeros_like(p) for name, p in model.named_parameters()}
    hybrid_iterations = math.floor(config.hybrid_share * config.steps)
    for t in range(1, config.steps + 1):
        interpolated = math.floor(config.alpha * config.batch) if t <= hybrid_iterations else 0
        flat = torch.randint(voxels.size, (config.batch - interpolated,), generator=generator).numpy()
        d, h, w = np.unravel_index(flat, voxels.shape)
        points = np.stack((canonical[2][w], canonical[1][h], canonical[0][d]), axis=-1)
        intensities = voxels[d, h, w]
        if interpolated:
            more = 2.0 * torch.rand(interpolated, 3, generator=generator).numpy().astype(np.float64) - 1.0
            points = np.concatenate((points, more))
            intensities = np.concatenate((intensities, trilinear(more[:, ::-1])))
        predicted = model(torch.from_numpy(points).float())
        loss = (predicted - torch.from_numpy(intensities).float()).square().mean()
        gradients = torch.autograd.grad(loss, list(model.parameters()))
        rate = config.learning_rate * config.final_rate_ratio ** ((t - 1) / config.steps)
        with torch.no_grad():  # Adam (Kingma and Ba, 2015)
            for (name, parameter), gradient in zip(model.named_parameters(), gradients, strict=True):
                first[name] = 0.9 * first[name] + 0.1 * gradient
                second[name] = 0.99 * second[name] + 0.01 * gradient**2
                step = (first[name] / (1 - 0.9**t)) / ((second[name] / (1 - 0.99**t)).sqrt() + 1e-15)
                parameter -= rate * step
        yield ("hybrid" if t <= hybrid_iterations else "discrete"), points, intensities, loss.item(), rate


def test_every_step_is_algorithm_1s(volume, monkeypatch):
    monkeypatch.setattr(progress, "REPORT_PERIOD_S", 0.0)
    batches, rates, models = [], [], []
    fitting = importlib.import_module("octn_ros.training.fit")  # the package's `fit` is the function
    batch, make, step = VoxelSampler.batch, fitting._seeded_model, torch.optim.Adam.step

    def spied_batch(self, *arguments):
        batches.append(batch(self, *arguments))
        return batches[-1]

    def spied_make(*arguments):
        model = make(*arguments)
        models.append(NeuralModel(CONFIG.field, SHAPE))
        models[-1].load_state_dict(model.state_dict())
        return model

    def spied_step(self, *arguments):
        rates.append(self.param_groups[0]["lr"])
        return step(self, *arguments)

    monkeypatch.setattr(VoxelSampler, "batch", spied_batch)
    monkeypatch.setattr(fitting, "_seeded_model", spied_make)
    monkeypatch.setattr(torch.optim.Adam, "step", spied_step)
    result = fit(volume, CONFIG)

    walked = list(algorithm_1(volume, CONFIG, models[0]))
    assert len(batches) == len(result.history) == len(walked) == 11
    assert (
        [stage for stage, *_ in walked]
        == [report.stage for report in result.history]
        == ["hybrid"] * 6 + ["discrete"] * 5
    )
    for (_, points, intensities, _, rate), got, got_rate in zip(walked, batches, rates, strict=True):
        np.testing.assert_allclose(got[0].numpy(), points, atol=1e-6)
        np.testing.assert_allclose(got[1].numpy(), intensities, atol=2e-6)
        assert got_rate == pytest.approx(rate)
    losses = [loss for *_, loss, _ in walked]
    np.testing.assert_allclose([report.loss for report in result.history], losses, rtol=1e-3)
    assert np.ptp(losses) > 0.005
    probe = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.no_grad():
        np.testing.assert_allclose(result.field.evaluate(probe).numpy(), models[0](probe).numpy(), atol=2e-3)


def test_the_paper_preset_is_what_the_paper_says():
    paper = PRESETS["paper"]
    grid, network = paper.field.grid, paper.field.network
    # "24 levels, with 2 features/level and a hash table of size 2^20 with base resolution of 16"
    assert (grid.levels, grid.features, grid.log2_table_size, grid.base_resolution) == (24, 2, 20, 16)
    # "3 hidden layers with 128 neurons per layer and ReLU activation, mapped to a linear output head"
    assert (network.hidden_layers, network.neurons) == (3, 128)
    model = NeuralModel(dataclasses.replace(paper.field, grid=dataclasses.replace(grid, log2_table_size=4)), SHAPE)
    assert [type(layer).__name__ for layer in model.network.hidden] == ["Linear", "ReLU"] * 3
    assert isinstance(model.network.output, torch.nn.Linear)
    assert not grid.follow_shape
    # "within 1000 iterations at alpha 0.20", without a clock
    assert (paper.alpha, paper.steps, paper.time_budget_s, paper.target_psnr_db) == (0.20, 1000, 0.0, 0.0)


def test_the_stages_share_a_fit_by_steps():
    for share, hybrid in ((0.0, 0), (0.25, 2), (0.29, 2), (1.0, 10)):
        schedule = progress.Schedule(dataclasses.replace(CONFIG, hybrid_share=share, steps=10))
        assert [schedule.stage(t) for t in range(1, 11)] == ["hybrid"] * hybrid + ["discrete"] * (10 - hybrid)
    assert progress.Schedule(dataclasses.replace(CONFIG, hybrid_share=0.29, steps=100)).stage(29) == "hybrid"
