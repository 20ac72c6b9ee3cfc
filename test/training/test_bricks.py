"""Compiled bricks: which samples they draw, their gradients against automatic differentiation, and that fits repeat."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.field.compiled.options import BRICK
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.training import FitConfig, brick_trainer, fit
from octn_ros.training.brick_trainer import BRICK_SAMPLES, BrickSampler, BrickTrainer, sample_count
from octn_ros.training.sampling import ResidentVoxels
from octn_ros.volume import Volume, VolumeGeometry

SHAPE = (20, 70, 33)
CONFIGS = [
    pytest.param(
        NeuralFieldConfig(HashGridConfig(levels=3, features=4, finest_ratio=0.5, follow_shape=True), NetworkConfig(1)),
        id="dense",
    ),
    pytest.param(
        NeuralFieldConfig(
            HashGridConfig(levels=4, features=3, log2_table_size=9, interpolation="smoothstep"), NetworkConfig(3, 30)
        ),
        id="hashed, smoothstep, three layers",
    ),
]


@pytest.fixture(scope="module")
def volume():
    return make_phantom(PhantomConfig(shape=SHAPE)).volume


def model_of(config, seed=0):
    torch.manual_seed(seed)
    return NeuralModel(config, SHAPE)


def never():
    return False


def points_of(bricks):
    """Canonical points (lateral, axial, bscan) and weights of all samples, in the kernels' order."""
    c, w = bricks.coordinates, bricks.weights
    axes = np.broadcast_arrays(c[:, 2, None, None, :], c[:, 1, None, :, None], c[:, 0, :, None, None])
    weight = w[:, 0, :, None, None] * w[:, 1, None, :, None] * w[:, 2, None, None, :]
    return torch.from_numpy(np.stack(axes, axis=-1).reshape(-1, 3)), torch.from_numpy(weight.reshape(-1))


@pytest.mark.parametrize("config", CONFIGS)
def test_gradients_are_those_of_automatic_differentiation(config, volume):
    model = model_of(config)
    with torch.no_grad():
        model.grid.table.uniform_(-1.0, 1.0)
    trainer = BrickTrainer(model, volume, 12 * BRICK_SAMPLES, seed=0)
    bricks = trainer._sampler.draw(12, 5)
    network, squared_error = trainer._pass(bricks)
    table = np.zeros_like(model.grid.table.detach().numpy())
    for n in range(12):
        rows, gradients, count = (array[n] for array in trainer._touched[:3])
        np.add.at(table, rows[:count], gradients[:count])

    points, weight = points_of(bricks)
    intensity = ResidentVoxels(volume, torch.device("cpu")).interpolate(points)
    error = (model(points) - intensity) * weight
    (0.5 * error.square().sum()).backward()
    assert squared_error == pytest.approx(float(error.detach().square().sum()), rel=1e-5)
    expected = model.grid.table.grad.numpy()
    np.testing.assert_allclose(table, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    parameters = [p for layer in model.network.linear_layers for p in (layer.weight, layer.bias)]
    for got, parameter in zip(network, parameters, strict=True):
        expected = parameter.grad.numpy()
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_a_first_step_is_adams(volume):
    """Adam's first step moves every parameter with a gradient by the learning rate, and no other."""
    model = model_of(CONFIGS[0].values[0])
    with torch.no_grad():
        model.grid.table.uniform_(-0.1, 0.1)
    before = [p.detach().clone() for p in model.parameters()]
    trainer = BrickTrainer(model, volume, BRICK_SAMPLES, seed=4)
    assert trainer.step(1e-3, 0.0, never) is not None
    moved = [(now.detach() - then).abs() for now, then in zip(model.parameters(), before, strict=True)]
    table = moved[0]
    assert 0 < int((table > 0).any(dim=1).sum()) <= trainer._touched.counts[0]
    changed = table[table > 0]
    torch.testing.assert_close(changed, torch.full_like(changed, 1e-3), rtol=1e-2, atol=0.0)


def test_every_voxel_is_equally_likely():
    """Over all first samples a brick can have, each voxel is sampled BRICK^3 times: exact, by the range alone."""
    shape = (3, 9, 12)
    sampler = BrickSampler(VolumeGeometry(shape, (1e-5, 1e-5, 1e-5)), seed=0)
    bricks = sampler.draw(60_000, 0)
    assert sample_count(bricks) == int(
        (bricks.weights[:, 0].sum(1) * bricks.weights[:, 1].sum(1) * bricks.weights[:, 2].sum(1)).sum()
    )
    for axis, size in enumerate(shape):
        counted = np.bincount(bricks.cell[:, axis][bricks.weights[:, axis] > 0], minlength=size)
        expected = 60_000 * BRICK / (size + BRICK - 1)
        assert counted.shape == (size,)
        assert np.abs(counted / expected - 1).max() < 0.03
    assert not bricks.share.any()


def test_shifted_bricks_lie_uniformly_between_voxels():
    shape = (4, 9, 12)
    bricks = BrickSampler(VolumeGeometry(shape, (1e-5, 1e-5, 1e-5)), seed=0).draw(40_000, 40_000)
    for axis in range(3):
        place = (bricks.cell[:, axis] + bricks.share[:, axis])[bricks.weights[:, axis] > 0]
        assert place.min() >= 0.0
        assert place.max() <= shape[axis] - 1
        counted, _ = np.histogram(place, bins=2 * (shape[axis] - 1), range=(0, shape[axis] - 1))
        assert np.abs(counted / counted.mean() - 1).max() < 0.05


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_targets_are_the_volumes_intensities(kind):
    generator = np.random.default_rng(0)
    raw = (generator.random((9, 12, 10)) * 200).astype(kind)
    volume = Volume.from_array(raw, (1e-5, 1e-5, 1e-5), intensity_range=(20.0, 150.0))
    config = NeuralFieldConfig(HashGridConfig(levels=1, base_resolution=4), NetworkConfig(1, 4))
    model = NeuralModel(config, raw.shape)
    with torch.no_grad():  # a field that is zero everywhere: its squared error is that of the targets
        model.network.output.weight.zero_()
        model.network.output.bias.zero_()
    trainer = BrickTrainer(model, volume, 6 * BRICK_SAMPLES, seed=1)
    for shifted in (0, 6):
        bricks = trainer._sampler.draw(6, shifted)
        _, squared_error = trainer._pass(bricks)
        points, weight = points_of(bricks)
        intensity = ResidentVoxels(volume, torch.device("cpu")).interpolate(points)
        assert squared_error == pytest.approx(float((intensity * weight).square().sum()), rel=1e-4)


def test_a_seeded_fit_repeats_whatever_the_number_of_threads(volume, monkeypatch):
    tables = []
    for threads in (1, 3, 3):
        with ThreadPoolExecutor(threads) as pool:
            monkeypatch.setattr(brick_trainer, "workers", lambda pool=pool: pool)
            model = model_of(CONFIGS[1].values[0])
            trainer = BrickTrainer(model, volume, 9 * BRICK_SAMPLES, seed=7)
            for _ in range(5):
                trainer.step(1e-2, 0.2, never)
        tables.append(torch.cat([p.detach().flatten() for p in model.parameters()]))
    assert torch.equal(tables[0], tables[1])
    assert torch.equal(tables[1], tables[2])


def test_it_learns_and_can_be_cancelled(volume):
    model = model_of(CONFIGS[0].values[0])
    trainer = BrickTrainer(model, volume, 16 * BRICK_SAMPLES, seed=0)
    errors = [trainer.step(1e-2, 0.2, never) for _ in range(60)]
    assert np.mean(errors[-5:]) < 0.1 * np.mean(errors[:5])
    before = model.grid.table.detach().clone()
    assert trainer.step(1e-2, 0.2, lambda: True) is None
    assert torch.equal(model.grid.table, before)


def test_a_spoilt_parameter_shows_in_the_loss(volume):
    """A fit that diverged is told by its loss, so NaN and infinity must pass through the kernels."""
    for spoilt in (float("nan"), float("inf")):
        model = model_of(CONFIGS[0].values[0])
        trainer = BrickTrainer(model, volume, 4 * BRICK_SAMPLES, seed=0)
        with torch.no_grad():
            model.network.output.bias.fill_(spoilt)
        assert not np.isfinite(trainer.step(1e-2, 0.2, never))


def test_a_compiled_fit_that_diverges_keeps_its_last_good_state(volume, monkeypatch):
    step, count = BrickTrainer.step, iter(range(1000))

    def spoils(self, rate, alpha, cancelled):
        if next(count) == 30:
            with torch.no_grad():
                self._model.network.output.bias.fill_(float("nan"))
        return step(self, rate, alpha, cancelled)

    monkeypatch.setattr(BrickTrainer, "step", spoils)
    config = FitConfig(field=CONFIGS[0].values[0], batch=1 << 14, steps=100, backend="compiled")
    result = fit(volume, config)
    assert result.ended == "diverged"
    assert 0 < result.steps <= 30
    assert np.isfinite(result.psnr_db)
    assert result.field.description.training["backend"] == "compiled"
