"""The compiled back end against the plain one: the same values and gradients for any shape of field."""

import numpy as np
import pytest
import torch

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.field.compiled import model as compiled_model
from octn_ros.field.compiled.evaluator import CompiledEvaluator
from octn_ros.field.compiled.layers import PAD

SHAPES = [(33, 57, 41), (2, 9, 64)]
CONFIGS = [
    pytest.param(NeuralFieldConfig(HashGridConfig(levels=3, features=4, follow_shape=True)), id="three hidden layers"),
    pytest.param(
        NeuralFieldConfig(
            HashGridConfig(levels=5, features=2, log2_table_size=9, finest_ratio=1.7), NetworkConfig(2, 30)
        ),
        id="hashed",
    ),
    pytest.param(
        NeuralFieldConfig(
            HashGridConfig(levels=1, features=3, base_resolution=5, interpolation="smoothstep"), NetworkConfig(1, 7)
        ),
        id="one level, smoothstep",
    ),
]


def random_model(config, shape, seed=0):
    torch.manual_seed(seed)
    model = NeuralModel(config, shape)
    with torch.no_grad():
        model.grid.table.uniform_(-1.0, 1.0)
    return model


def points_away_from_faces(model, count):
    """Points, some outside the cube, whose cell does not hang on the last bit of a float32."""
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 2.4 - 1.2
    unit = (points.double().clamp(-1, 1) + 1) / 2
    for level in model.grid.grid_levels:
        position = unit * torch.tensor(level.scale, dtype=torch.float64) + 0.5
        points = points[((position - position.round()).abs() > 1e-3).all(dim=1)]
        unit = (points.double().clamp(-1, 1) + 1) / 2
    return points


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("config", CONFIGS)
def test_values_and_gradients_at_points(config, shape):
    model = random_model(config, shape)
    points = points_away_from_faces(model, 3001).requires_grad_(True)
    expected = model(points)
    (gradient,) = torch.autograd.grad(expected.sum(), points)
    values, gradients = CompiledEvaluator(model).value_and_gradient(points)
    assert len(points) > 1000
    torch.testing.assert_close(values, expected.detach(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients, gradient, rtol=1e-4, atol=1e-4 * float(gradient.abs().max()))
    torch.testing.assert_close(CompiledEvaluator(model).evaluate(points), values, rtol=1e-6, atol=1e-6)
    outside = (points.abs() > 1).any(dim=1)
    assert outside.any()
    assert (gradients[points.detach().abs() > 1] == 0).all()


@pytest.mark.parametrize("config", CONFIGS)
def test_values_on_cell_faces(config):
    model = random_model(config, SHAPES[0])
    faces = []
    for level in model.grid.grid_levels:
        for axis in range(3):
            point = torch.rand(20, 3, generator=torch.Generator().manual_seed(axis)) * 2 - 1
            point[:, axis] = (torch.arange(1, 21) % int(level.scale[axis]) + 0.5) / level.scale[axis] * 2 - 1
            faces.append(point)
    faces = torch.cat(faces)
    torch.testing.assert_close(
        CompiledEvaluator(model).evaluate(faces), model(faces).detach(), rtol=1e-4, atol=1e-4
    )  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("config", CONFIGS)
def test_a_lattice_is_its_points(config, shape):
    """Native, fractional, coarse, unsorted and single coordinates alike; sizes that are no multiple of a brick."""
    model = random_model(config, shape)
    generator = torch.Generator().manual_seed(3)
    lateral = torch.linspace(-1, 1, shape[2])
    axial = torch.cat((torch.tensor([0.3, -1.2, 1.0]), torch.rand(8, generator=generator)))
    for bscan in (torch.linspace(-1, 1, 17), torch.tensor([0.123])):
        got = CompiledEvaluator(model).lattice(lateral, axial, bscan)
        slow, middle, fast = torch.meshgrid(bscan, axial, lateral, indexing="ij")
        expected = model(torch.stack((fast, middle, slow), dim=-1).view(-1, 3)).detach().view(got.shape)
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_nothing_to_evaluate():
    evaluator = CompiledEvaluator(random_model(NeuralFieldConfig(HashGridConfig(levels=1)), SHAPES[0]))
    values, gradients = evaluator.value_and_gradient(torch.zeros(0, 3))
    assert values.shape == (0,)
    assert gradients.shape == (0, 3)
    axis = torch.linspace(-1, 1, 3)
    assert evaluator.lattice(axis, axis, axis[:0]).shape == (0, 3, 3)


def test_the_network_is_padded_and_the_table_shared():
    model = random_model(
        NeuralFieldConfig(HashGridConfig(levels=1, features=3), NetworkConfig(2, 5)), SHAPES[0]
    )  # fmt: skip
    perceptron = compiled_model.perceptron_of(model)
    assert perceptron.first.shape == (8, PAD)
    np.testing.assert_array_equal(perceptron.first[:5, :3], model.network.hidden[0].weight.detach().numpy())
    assert not perceptron.first[5:].any()
    assert not perceptron.first[:, 3:].any()
    evaluator = CompiledEvaluator(model)
    point = torch.zeros(1, 3)
    before = evaluator.evaluate(point)
    with torch.no_grad():
        model.grid.table.mul_(-1.0)
    assert evaluator.evaluate(point) != before
