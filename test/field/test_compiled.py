"""The compiled back end against the plain one: the same values and gradients for any shape of field."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from octn_ros.errors import BackendWarning, ConfigurationError
from octn_ros.field import (
    FieldDescription,
    HashGridConfig,
    NetworkConfig,
    NeuralField,
    NeuralFieldConfig,
    NeuralModel,
)
from octn_ros.field.compiled import model as compiled_model
from octn_ros.field.compiled.evaluator import CompiledEvaluator
from octn_ros.field.compiled.layers import PAD
from octn_ros.volume import VolumeGeometry

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


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("depths", ["one", "two far apart", "close and unsorted", "every voxel"])
def test_lines_are_their_points(config, shape, depths):
    model = random_model(config, shape)
    points = points_away_from_faces(model, 400)[:131]
    lateral, axial, bscan = points.T.contiguous()
    generator = torch.Generator().manual_seed(4)
    axial = {
        "one": axial[:, None],
        "two far apart": torch.stack((axial, -axial), dim=1),
        "close and unsorted": axial[:, None] + 0.2 * torch.rand(len(axial), 9, generator=generator),
        "every voxel": torch.linspace(-1, 1, shape[1]).expand(len(axial), -1),
    }[depths]
    expected = model(torch.stack((lateral[:, None].expand_as(axial), axial, bscan[:, None].expand_as(axial)), dim=-1)
                     .view(-1, 3)).detach().view(axial.shape)  # fmt: skip
    got = CompiledEvaluator(model).axial_lines(lateral, bscan, axial)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("config", CONFIGS)
def test_axial_slopes_are_those_of_the_gradient(config, shape):
    model = random_model(config, shape)
    points = points_away_from_faces(model, 1001)
    evaluator = CompiledEvaluator(model)
    values, gradients = evaluator.value_and_gradient(points)
    value, slope = evaluator.axial_value_and_slope(*points.T)
    torch.testing.assert_close(value, values, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(slope, gradients[:, 1], rtol=1e-4, atol=1e-4 * float(gradients.abs().max()))
    assert (slope[points[:, 1].abs() > 1] == 0).all()


def test_nothing_to_evaluate():
    evaluator = CompiledEvaluator(random_model(NeuralFieldConfig(HashGridConfig(levels=1)), SHAPES[0]))
    values, gradients = evaluator.value_and_gradient(torch.zeros(0, 3))
    assert values.shape == (0,)
    assert gradients.shape == (0, 3)
    axis = torch.linspace(-1, 1, 3)
    assert evaluator.lattice(axis, axis, axis[:0]).shape == (0, 3, 3)
    assert evaluator.axial_lines(axis[:0], axis[:0], torch.zeros(0, 4)).shape == (0, 4)
    assert evaluator.axial_lines(axis, axis, torch.zeros(3, 0)).shape == (3, 0)
    assert evaluator.axial_value_and_slope(axis[:0], axis[:0], axis[:0])[1].shape == (0,)


def test_nowhere_has_no_intensity():
    model = random_model(CONFIGS[0].values[0], SHAPES[0])
    points = torch.zeros(70, 3)
    points[3, 1], points[66, 2], points[5, 0] = torch.nan, torch.nan, torch.inf
    values, gradients = CompiledEvaluator(model).value_and_gradient(points)
    nowhere = torch.zeros(70, dtype=torch.bool)
    nowhere[[3, 66]] = True
    assert torch.equal(values.isnan(), nowhere)
    assert torch.equal(gradients.isnan().any(dim=1), nowhere)
    axial = CompiledEvaluator(model).axial_value_and_slope(*points.T)
    assert all(torch.equal(part.isnan(), nowhere) for part in axial)
    lines = CompiledEvaluator(model).axial_lines(points[:7, 0], points[:7, 2], points[:14, 1].view(7, 2))
    assert torch.equal(lines.isnan(), torch.tensor([[False, False], [False, True]] + [[False, False]] * 5))
    axis = torch.tensor([0.0, torch.nan, 0.5])
    lattice = CompiledEvaluator(model).lattice(axis, axis[:1], axis[::2])
    assert torch.equal(lattice.isnan(), torch.tensor([[[False, True, False]]] * 2))


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


def field_of(model, backend="auto"):
    geometry = VolumeGeometry(SHAPES[0], (1e-5, 1e-5, 1e-5))
    description = FieldDescription("neural", geometry, (0.0, 1.0), "log")
    return NeuralField(model, NeuralFieldConfig(), description, backend)


def test_a_field_answers_alike_through_either_back_end():
    model = random_model(CONFIGS[1].values[0], SHAPES[0])
    fast, plain = field_of(model), field_of(model, "torch")
    assert (fast.backend, plain.backend) == ("compiled", "torch")
    points = points_away_from_faces(model, 2001)
    lateral, axial, bscan = points.T.contiguous()
    depths = axial[:, None].repeat(1, 3)
    for ask in (
        lambda field: field.evaluate(points),
        lambda field: field.value_and_gradient(points),
        lambda field: field.axial_value_and_slope(lateral, axial, bscan),
        lambda field: field.axial_lines(lateral, bscan, depths),
        lambda field: field.lattice(lateral[:20], axial[:9], bscan[:3]),
    ):
        torch.testing.assert_close(ask(fast), ask(plain), rtol=1e-4, atol=2e-3)
    assert fast.evaluate(points.requires_grad_(True)).requires_grad


@pytest.mark.parametrize("kind", ["softplus", "float64"])
def test_what_kernels_cannot_run_plain_torch_answers(kind):
    network = NetworkConfig(1, 8, activation="softplus" if kind == "softplus" else "relu")
    model = random_model(NeuralFieldConfig(HashGridConfig(levels=1), network), SHAPES[0])
    if kind == "float64":
        model = model.double()
    assert field_of(model).backend == "torch"
    with pytest.warns(BackendWarning, match=r"compiled was asked for.*(Softplus|float64)"):
        assert field_of(model, "compiled").backend == "torch"
    with pytest.raises(ConfigurationError, match="expected one of auto, torch, compiled"):
        field_of(model, "fortran")


def test_importing_loads_no_compiler():
    code = (
        "import sys, octn_ros.field, octn_ros.training, octn_ros.query; "
        "assert not {'numba', 'triton', 'tinycudann'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
