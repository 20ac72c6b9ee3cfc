"""Every compiled path against plain torch: values and gradients, over configurations drawn at random."""

import numpy as np
import pytest
import torch

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.field.compiled.evaluator import CompiledEvaluator
from octn_ros.training.brick_trainer import BRICK_SAMPLES, BrickTrainer
from octn_ros.training.sampling import ResidentVoxels
from octn_ros.volume import Volume

DRAWS = 14
# The kernels promise 1e-4 relative in float32.
RELATIVE = 1e-4


def drawn(number):
    """A random configuration and an odd shape; every third one is hashed into few rows."""
    generator = np.random.default_rng(1000 + number)
    levels = int(generator.integers(1, 7))
    grid = HashGridConfig(
        levels=levels,
        features=int(generator.integers(1, 6)),
        log2_table_size=int(generator.integers(5, 9)) if number % 3 == 0 else 16,
        base_resolution=int(generator.integers(2, 10)),
        finest_ratio=float(generator.uniform(0.1, 2.0)),
        follow_shape=bool(generator.integers(2)),
        axial_refinement=float(generator.choice([1.0, 2.0])),
        interpolation=str(generator.choice(["linear", "smoothstep"])),
    )
    network = NetworkConfig(int(generator.integers(1, 4)), int(generator.integers(1, 41)))
    shape = tuple(int(n) for n in generator.integers(2, 44, 3))
    return NeuralFieldConfig(grid, network), shape


def model_of(config, shape, seed):
    torch.manual_seed(seed)
    model = NeuralModel(config, shape)
    with torch.no_grad():
        model.grid.table.uniform_(-1.0, 1.0)
    return model


def volume_of(shape, seed=0):
    raw = np.random.default_rng(seed).integers(0, 255, shape).astype(np.uint8)
    return Volume.from_array(raw, (1e-5, 1e-5, 1e-5))


def off_faces(model, points):
    """Those of the points whose cell does not hang on the last bit of a float32."""
    kept = torch.ones(len(points), dtype=torch.bool)
    for level in model.grid.grid_levels:
        position = (points.double() + 1) / 2 * torch.tensor(level.scale, dtype=torch.float64) + 0.5
        kept &= ((position - position.round()).abs() > 1e-3).all(dim=1)
    return points[kept]


def close(got, expected, relative=RELATIVE):
    """Within `relative` of the largest value there: sums of both signs have no relative accuracy of their own."""
    scale = float(np.abs(expected).max())
    np.testing.assert_allclose(got, expected, rtol=relative, atol=relative * max(scale, 1e-6))


@pytest.mark.parametrize("number", range(DRAWS))
def test_values_gradients_and_lattices(number):
    config, shape = drawn(number)
    model = model_of(config, shape, number)
    generator = torch.Generator().manual_seed(number)
    points = off_faces(model, torch.rand(1500, 3, generator=generator) * 2 - 1).requires_grad_(True)
    assert len(points) > 500
    expected = model(points)
    (gradient,) = torch.autograd.grad(expected.sum(), points)
    evaluator = CompiledEvaluator(model)
    values, gradients = evaluator.value_and_gradient(points)
    close(values.numpy(), expected.detach().numpy())
    close(gradients.numpy(), gradient.numpy())
    bscan, axial, lateral = (torch.linspace(-1, 1, n) for n in shape)
    slow, middle, fast = torch.meshgrid(bscan, axial, lateral, indexing="ij")
    on_lattice = model(torch.stack((fast, middle, slow), dim=-1).view(-1, 3)).detach().view(shape)
    close(evaluator.lattice(lateral, axial, bscan).numpy(), on_lattice.numpy())


def parity_of_a_pass(model, volume, interpolated, seed):
    """Hold one compiled pass of 9 bricks against automatic differentiation at the same samples."""
    trainer = BrickTrainer(model, volume, 9 * BRICK_SAMPLES, seed=seed)
    bricks = trainer._sampler.draw(9, interpolated)
    network, squared_error = trainer._pass(bricks)
    table = np.zeros_like(model.grid.table.detach().numpy())
    touched = trainer._touched
    for n, count in enumerate(touched.counts):
        np.add.at(table, touched.rows[n, :count], touched.gradients[n, :count])
        assert sorted(touched.order[n, :count]) == list(range(count))
    c, w = bricks.coordinates, bricks.weights
    axes = np.broadcast_arrays(c[:, 2, None, None, :], c[:, 1, None, :, None], c[:, 0, :, None, None])
    points = torch.from_numpy(np.stack(axes, axis=-1).reshape(-1, 3))
    weight = torch.from_numpy(
        (w[:, 0, :, None, None] * w[:, 1, None, :, None] * w[:, 2, None, None, :]).reshape(-1)
    )  # fmt: skip
    error = (model(points) - ResidentVoxels(volume, torch.device("cpu")).interpolate(points)) * weight
    (0.5 * error.square().sum()).backward()
    assert squared_error == pytest.approx(float(error.detach().square().sum()), rel=RELATIVE)
    close(table, model.grid.table.grad.numpy())
    parameters = [p for layer in model.network.linear_layers for p in (layer.weight, layer.bias)]
    for got, parameter in zip(network, parameters, strict=True):
        close(got, parameter.grad.numpy())


@pytest.mark.parametrize("number", range(DRAWS))
def test_gradients_of_a_step(number):
    config, shape = drawn(number)
    parity_of_a_pass(model_of(config, shape, number), volume_of(shape), interpolated=number % 10, seed=number)


# Scales of 16 and 8 cells on 33 voxels: every second or fourth voxel lies on a face, all numbers exact in float32.
ON_FACES = NeuralFieldConfig(
    HashGridConfig(levels=2, features=2, base_resolution=9, finest_ratio=17 / 33), NetworkConfig(2, 12)
)


def test_voxels_on_cell_faces():
    shape = (33, 33, 33)
    model = model_of(ON_FACES, shape, 3)
    axis = torch.linspace(-1, 1, 33, dtype=torch.float64)
    for level, cells in zip(model.grid.grid_levels, (8, 16), strict=True):
        assert level.scale == pytest.approx((cells,) * 3)
        position = (axis + 1) / 2 * cells + 0.5
        assert int((position == position.round()).sum()) >= 8
    lateral = bscan = axial = axis.float()
    slow, middle, fast = torch.meshgrid(bscan, axial, lateral, indexing="ij")
    points = torch.stack((fast, middle, slow), dim=-1).view(-1, 3)[::7].clone().requires_grad_(True)
    expected = model(points)
    (gradient,) = torch.autograd.grad(expected.sum(), points)
    values, gradients = CompiledEvaluator(model).value_and_gradient(points)
    close(values.numpy(), expected.detach().numpy())
    close(gradients.numpy(), gradient.numpy())  # of the cell on the far side, both
    parity_of_a_pass(model, volume_of(shape), interpolated=0, seed=5)
