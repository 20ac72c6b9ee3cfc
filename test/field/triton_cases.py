"""What the Triton kernels must answer: run by test_triton.py in a process of its own, on a GPU or interpreted.

Triton decides when it is imported whether kernels are interpreted, so these cases share no process with other tests.
"""

import os
from typing import NamedTuple

import pytest
import torch

from octn_ros.errors import BackendWarning
from octn_ros.field import (
    FieldDescription,
    HashGridConfig,
    NetworkConfig,
    NeuralField,
    NeuralFieldConfig,
    NeuralModel,
)
from octn_ros.field.cuda.encoding import TritonEncoding
from octn_ros.field.cuda.evaluator import TritonEvaluator, TritonModel
from octn_ros.training import FitConfig, fit
from octn_ros.volume import Volume, VolumeGeometry

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = torch.device("cpu" if INTERPRETED else "cuda")
# The interpreter takes some 50 us for every operation of every block: one block of most kernels will do.
POINTS = 61 if INTERPRETED else 20_001


class Case(NamedTuple):
    shape: tuple[int, int, int]
    grid: HashGridConfig
    network: NetworkConfig

    @property
    def config(self):
        return NeuralFieldConfig(self.grid, self.network)


CASES = {
    "three hidden layers of 128": Case(
        (33, 57, 41), HashGridConfig(levels=3, features=4, follow_shape=True), NetworkConfig()
    ),
    "hashed, softplus": Case(
        (33, 57, 41),
        HashGridConfig(levels=4, features=2, log2_table_size=9, finest_ratio=1.7),
        NetworkConfig(2, 30, activation="softplus"),
    ),
    "one level, three features, smoothstep": Case(
        (2, 9, 64),
        HashGridConfig(levels=1, features=3, base_resolution=5, interpolation="smoothstep"),
        NetworkConfig(1, 7),
    ),
    "hashed, smoothstep, more features than a strip": Case(
        (2, 9, 64),
        HashGridConfig(levels=3, features=7, log2_table_size=5, base_resolution=3, interpolation="smoothstep"),
        NetworkConfig(2, 64),
    ),
    "too wide to fuse": Case(
        (20, 20, 20), HashGridConfig(levels=2, features=1, log2_table_size=8), NetworkConfig(2, 130)
    ),
}
cases = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())


def random_model(case):
    torch.manual_seed(0)
    model = NeuralModel(case.config, case.shape)
    with torch.no_grad():
        model.grid.table.uniform_(-1.0, 1.0)
    return model.to(DEVICE)


def points_inside_and_out():
    return (torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(1)) * 2.4 - 1.2).to(DEVICE)


def points_on_faces(model):
    """Points of which one coordinate lies on a cell face of one level, and the corners of the cube."""
    faces = [torch.tensor([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [1.0, -1.0, 1.0]])]
    for level in model.grid.grid_levels:
        for axis in range(3):
            point = torch.rand(3, 3, generator=torch.Generator().manual_seed(axis)) * 2 - 1
            point[:, axis] = (torch.arange(1, 4) % max(int(level.scale[axis]), 1) + 0.5) / level.scale[axis] * 2 - 1
            faces.append(point)
    return torch.cat(faces).to(DEVICE)


def assert_close(got, expected):
    """Within 1e-4 of the largest value: what sums of float32 in another order may differ by."""
    expected = expected.detach()
    torch.testing.assert_close(got.detach(), expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


@cases
def test_features_and_their_gradients(case):
    model = random_model(case)
    grid = model.grid
    points = torch.cat((points_inside_and_out(), points_on_faces(model))).requires_grad_(True)
    weights = torch.rand(len(points), grid.width, generator=torch.Generator().manual_seed(2)).to(DEVICE)
    expected = grid(points)
    got = TritonEncoding(grid)(points)
    assert_close(got, expected)
    by_points, by_table = torch.autograd.grad((expected * weights).sum(), (points, grid.table))
    got_by_points, got_by_table = torch.autograd.grad((got * weights).sum(), (points, grid.table))
    assert_close(got_by_points, by_points)
    assert_close(got_by_table, by_table)
    assert (got_by_points[points.detach().abs() > 1] == 0).all()
    assert len(got_by_table.nonzero()) > 10


@cases
def test_values_and_gradients_of_a_field(case):
    model = random_model(case)
    points = torch.cat((points_inside_and_out(), points_on_faces(model))).requires_grad_(True)
    expected = model(points)
    (gradient,) = torch.autograd.grad(expected.sum(), points)
    evaluator = TritonEvaluator(model)
    values, gradients = evaluator.value_and_gradient(points)
    assert_close(evaluator.evaluate(points), expected.detach())
    assert_close(values, expected.detach())
    assert_close(gradients, gradient)
    lateral, axial, bscan = points.detach().T.contiguous()
    assert_close(evaluator.axial_value_and_slope(lateral, axial, bscan)[1], gradient[:, 1])


@cases
def test_a_lattice_and_lines_are_their_points(case):
    """Fractional, outlying, unsorted and single coordinates alike; sizes that are no multiple of a block."""
    model = random_model(case)
    evaluator = TritonEvaluator(model)
    lateral = torch.linspace(-1, 1, 13, device=DEVICE)
    axial = torch.tensor([0.3, -1.2, 1.0, 0.9, -0.41], device=DEVICE)
    bscan = torch.tensor([0.123, -0.7], device=DEVICE)
    got = evaluator.lattice(lateral, axial, bscan)
    slow, middle, fast = torch.meshgrid(bscan, axial, lateral, indexing="ij")
    assert_close(got, model(torch.stack((fast, middle, slow), dim=-1).view(-1, 3)).detach().view(got.shape))
    depths = axial.repeat(2, 1)
    lines = evaluator.axial_lines(lateral[:2], bscan, depths)
    assert_close(lines, torch.stack((got[0, :, 0], got[1, :, 1])))


@cases
def test_gradients_of_training(case):
    model = random_model(case)
    points, targets = points_inside_and_out(), torch.rand(POINTS, device=DEVICE)
    gradients = []
    for forward in (model, TritonModel(model)):
        model.zero_grad()
        (forward(points) - targets).square().mean().backward()
        gradients.append([parameter.grad for parameter in model.parameters()])
    for got, expected in zip(*gradients, strict=True):
        assert_close(got, expected)


def test_many_points_in_one_cell_all_count():
    """Atomic additions: every point of a block adds to the same eight rows."""
    case = CASES["one level, three features, smoothstep"]
    grid = random_model(case).grid
    points = torch.full((1000, 3), 0.01, device=DEVICE)
    (by_table,) = torch.autograd.grad(TritonEncoding(grid)(points).sum(), grid.table)
    assert float(by_table.sum()) == pytest.approx(3000.0, rel=1e-5)
    assert len(by_table.nonzero()) == 24


def test_second_derivatives_are_refused_by_the_kernels_and_answered_by_the_field():
    model = random_model(CASES["one level, three features, smoothstep"])
    points = points_inside_and_out()[:20].requires_grad_(True)
    (gradient,) = torch.autograd.grad(TritonModel(model)(points).sum(), points, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
    fast, plain = (field_of(model, backend) for backend in ("triton", "torch"))
    for got, expected in zip(fast.value_gradient_hessian(points), plain.value_gradient_hessian(points), strict=True):
        assert_close(got, expected)


def test_nowhere_has_no_intensity():
    model = random_model(CASES["hashed, softplus"])
    points = torch.zeros(7, 3, device=DEVICE)
    points[3, 1], points[6, 2], points[5, 0] = torch.nan, torch.nan, torch.inf
    evaluator = TritonEvaluator(model)
    values, gradients = evaluator.value_and_gradient(points)
    nowhere = [False, False, False, True, False, False, True]
    assert values.isnan().tolist() == nowhere
    assert evaluator.evaluate(points).isnan().tolist() == nowhere
    assert gradients.isnan().any(dim=1).tolist() == nowhere


@pytest.mark.parametrize("name", ["three hidden layers of 128", "too wide to fuse"])
def test_nothing_to_evaluate(name):
    evaluator = TritonEvaluator(random_model(CASES[name]))
    nothing = torch.zeros(0, 3, device=DEVICE)
    values, gradients = evaluator.value_and_gradient(nothing)
    assert (values.shape, gradients.shape, evaluator.evaluate(nothing).shape) == ((0,), (0, 3), (0,))
    axis = torch.linspace(-1, 1, 3, device=DEVICE)
    assert evaluator.lattice(axis, axis, axis[:0]).shape == (0, 3, 3)


def test_a_diverged_network_shows():
    model = random_model(CASES["three hidden layers of 128"])
    with torch.no_grad():
        model.network.hidden[0].weight[5, 0] = torch.nan
    assert TritonEvaluator(model).evaluate(torch.zeros(3, 3, device=DEVICE)).isnan().all()


def field_of(model, backend):
    description = FieldDescription("neural", VolumeGeometry((33, 57, 41), (1e-5, 1e-5, 1e-5)), (0.0, 1.0), "log")
    return NeuralField(model, NeuralFieldConfig(model.grid.config), description, backend)


def test_a_field_answers_alike_through_either_back_end():
    model = random_model(CASES["hashed, softplus"])
    fast, plain = field_of(model, "triton"), field_of(model, "torch")
    assert (fast.backend, plain.backend) == ("triton", "torch")
    points = points_inside_and_out()[:50]
    lateral, axial, bscan = points.T.contiguous()
    for ask in (
        lambda field: field.evaluate(points),
        lambda field: field.value_and_gradient(points)[1],
        lambda field: field.axial_value_and_slope(lateral, axial, bscan)[1],
        lambda field: field.axial_lines(lateral[:9], bscan[:9], axial[:9, None].repeat(1, 3)),
        lambda field: field.lattice(lateral[:7], axial[:5], bscan[:3]),
    ):
        assert_close(ask(fast), ask(plain))
    assert fast.evaluate(points.requires_grad_(True)).requires_grad


def test_float64_is_left_to_the_reference_with_a_warning():
    model = random_model(CASES["hashed, softplus"]).double()
    with pytest.warns(BackendWarning, match=r"triton.*float64"):
        assert field_of(model, "triton").backend == "torch"


def test_a_fit_by_triton_is_that_by_torch(monkeypatch):
    """The same samples, two stages and steps; Adam lets rounding grow, so the fields agree as fits do."""
    monkeypatch.setattr("octn_ros.training.held_in.EVALUATED_VOXELS", 256)
    array = torch.rand(12, 14, 16, generator=torch.Generator().manual_seed(0)).numpy()
    volume = Volume.from_array(array, (1e-5, 1e-5, 1e-5))
    results = {}
    for backend in ("triton", "torch"):
        config = FitConfig(
            field=NeuralFieldConfig(
                HashGridConfig(levels=2, log2_table_size=8, base_resolution=4), NetworkConfig(1, 16)
            ),
            steps=8,
            batch=120,
            backend=backend,
        )
        results[backend] = fit(volume, config, device=DEVICE)
    assert results["triton"].field.description.training["backend"] == "triton"
    points = points_inside_and_out()
    values = [results[backend].field.evaluate(points) for backend in results]
    assert (values[0] - values[1]).abs().mean() < 0.01 * values[1].std()
    assert results["triton"].psnr_db == pytest.approx(results["torch"].psnr_db, abs=0.02)
    assert [report.stage for report in results["triton"].history][-1] == "discrete"
