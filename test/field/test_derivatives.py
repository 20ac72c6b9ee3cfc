"""Exact derivatives: fast paths against automatic differentiation, and both against differences in float64."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from octn_ros.field import (
    FieldDescription,
    HashGridConfig,
    InterpolatedField,
    NetworkConfig,
    NeuralField,
    NeuralFieldConfig,
    NeuralModel,
)
from octn_ros.field.field import DifferentiableField
from octn_ros.volume import Volume

SPACING = (28e-6, 14.59e-6, 14e-6)
SHAPE = (6, 9, 8)
KINDS = ["linear-relu", "smoothstep-softplus", "trilinear", "cubic"]
DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


def volume(seed=2):
    return Volume.from_array(np.random.default_rng(seed).random(SHAPE), SPACING)


def neural(config, seed=0, dtype=torch.float64, device="cpu"):
    torch.manual_seed(seed)
    model = NeuralModel(config, SHAPE)
    with torch.no_grad():
        model.grid.table.uniform_(-1, 1)
    description = FieldDescription.of_volume(volume(), "neural")
    return NeuralField(model.to(device, dtype), config, description, backend="torch")


def made(kind, device="cpu"):
    if kind in ("trilinear", "cubic"):
        return InterpolatedField(volume(), device, order=kind)
    interpolation, activation = kind.split("-")
    grid = HashGridConfig(levels=3, features=2, log2_table_size=7, base_resolution=4, interpolation=interpolation)
    return neural(NeuralFieldConfig(grid, NetworkConfig(2, 16, activation)), device=device)


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(params=DEVICES)
def field(kind, request):
    return made(kind, request.param)


def scattered(count, seed=0, dtype=torch.float64, device="cpu", reach=1.0):
    generator = torch.Generator().manual_seed(seed)
    return ((torch.rand(count, 3, dtype=torch.float64, generator=generator) * 2 - 1) * reach).to(device, dtype)


def inside_cells(field, points, margin=0.02):
    """Keep points that are further than a margin, in cells, from every face of every cell."""
    if isinstance(field, InterpolatedField):
        positions = [field.geometry.canonical_to_voxel(points)]
    else:
        levels = field.model.grid.grid_levels
        positions = [(points + 1) / 2 * points.new_tensor(level.scale) + 0.5 for level in levels]
    keep = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for position in positions:
        keep &= ((position - position.round()).abs() > margin).all(-1)
    return points[keep]


configurations = st.builds(
    NeuralFieldConfig,
    st.builds(
        HashGridConfig,
        levels=st.integers(1, 6),
        features=st.integers(1, 4),
        log2_table_size=st.integers(4, 12),
        base_resolution=st.integers(2, 12),
        finest_ratio=st.floats(0.3, 2.0),
        follow_shape=st.booleans(),
        interpolation=st.sampled_from(["linear", "smoothstep"]),
    ),
    st.builds(NetworkConfig, st.integers(1, 3), st.integers(1, 24), st.sampled_from(["relu", "softplus"])),
)


# Some of its features lie where torch answers for softplus with a line, 2e-9 steeper than the curve.
PAST_THE_THRESHOLD = NeuralFieldConfig(
    HashGridConfig(5, 1, log2_table_size=5, base_resolution=3, finest_ratio=2.0, follow_shape=False,
                   interpolation="smoothstep"),
    NetworkConfig(1, 4, "softplus"),
)  # fmt: skip


@example(PAST_THE_THRESHOLD, 301, torch.float64)
@given(configurations, st.integers(0, 1000), st.sampled_from([torch.float32, torch.float64]))
@settings(max_examples=40, deadline=None)
def test_fast_paths_of_any_neural_field_equal_automatic_differentiation(config, seed, dtype):
    field = neural(config, seed, dtype)
    points = scattered(40, seed, dtype, reach=1.2)
    tolerance = {"rtol": 1e-9, "atol": 1e-9} if dtype == torch.float64 else {"rtol": 2e-3, "atol": 2e-3}
    value, slope = field.axial_value_and_slope(*points.unbind(-1))
    expected_value, expected_gradient = DifferentiableField.value_and_gradient(field, points)
    torch.testing.assert_close(value, expected_value, **tolerance)
    torch.testing.assert_close(slope, expected_gradient[:, 1], **tolerance)
    depth = scattered(40, seed + 1, dtype, reach=1.2).repeat(1, 3)
    lines = field.axial_lines(points[:, 0], points[:, 2], depth)
    reference = DifferentiableField._line_values(field, points[:, 0], points[:, 2], depth)
    torch.testing.assert_close(lines, reference, **tolerance)


def test_axial_slope_is_the_axial_part_of_the_gradient(field):
    points = scattered(500, reach=1.2, device=field.device)
    value, slope = field.axial_value_and_slope(*points.unbind(-1))
    reference, gradient = DifferentiableField.value_and_gradient(field, points)
    torch.testing.assert_close(value, reference, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(slope, gradient[:, 1], rtol=1e-5, atol=1e-5)
    assert not slope.requires_grad


@pytest.mark.parametrize("reach", [0.05, 1.2])
def test_axial_lines_equal_points(field, reach):
    """Depths close together share vertices; depths far apart take another path."""
    across = scattered(30, device=field.device)
    depth = scattered(30, seed=1, device=field.device).repeat(1, 4) * reach
    expected = DifferentiableField._line_values(field, across[:, 0], across[:, 2], depth)
    got = field.axial_lines(across[:, 0], across[:, 2], depth)
    torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)
    for width in (1, 2):
        got = field.axial_lines(across[:, 0], across[:, 2], depth[:, :width])
        torch.testing.assert_close(got, expected[:, :width], rtol=1e-6, atol=1e-6)


def test_nothing_in_gives_nothing_out(field):
    none = torch.zeros(0, dtype=torch.float64, device=field.device)
    points = torch.zeros(0, 3, dtype=torch.float64, device=field.device)
    value, slope = field.axial_value_and_slope(none, none, none)
    assert (value.shape, slope.shape) == ((0,), (0,))
    assert field.axial_lines(none, none, points).shape == (0, 3)
    assert field.axial_lines(none.new_zeros(2), none.new_zeros(2), none.new_zeros(2, 0)).shape == (2, 0)
    value, gradient, hessian = field.value_gradient_hessian(points)
    assert (value.shape, gradient.shape, hessian.shape) == ((0,), (0, 3), (0, 3, 3))
    assert field.evaluate(points).shape == (0,)
    assert field.lattice(none, none, none).shape == (0, 0, 0)


def test_first_derivatives_match_central_differences_inside_cells(field):
    points, step = inside_cells(field, scattered(400, reach=0.99, device=field.device)), 1e-6
    assert len(points) > 150
    value, gradient, _ = field.value_gradient_hessian(points)
    torch.testing.assert_close(value, field.evaluate(points))
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64, device=field.device)
        shift[axis] = step
        difference = (field.evaluate(points + shift) - field.evaluate(points - shift)) / (2 * step)
        torch.testing.assert_close(gradient[:, axis], difference, rtol=1e-5, atol=2e-5)


def test_second_derivatives_match_central_differences_of_the_gradient(field):
    points, step = inside_cells(field, scattered(400, reach=0.99, device=field.device)), 1e-5
    _, _, hessian = field.value_gradient_hessian(points)
    torch.testing.assert_close(hessian, hessian.transpose(1, 2), rtol=1e-7, atol=1e-7)
    scale = float(hessian.abs().max())
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64, device=field.device)
        shift[axis] = step
        ahead, behind = (field.value_and_gradient(points + sign * shift)[1] for sign in (1, -1))
        difference = (ahead - behind) / (2 * step)
        # A kink of a ReLU between the two points shows in the difference alone; few points have one so near.
        agrees = ((hessian[:, axis] - difference).abs() < 1e-4 * scale).all(-1)
        assert agrees.double().mean() > 0.98


@pytest.mark.parametrize("kind", ["linear-relu", "trilinear"])
def test_piecewise_linear_fields_have_no_unmixed_curvature(kind):
    field = made(kind)
    _, _, hessian = field.value_gradient_hessian(scattered(200))
    unmixed = torch.diagonal(hessian, dim1=1, dim2=2)
    if kind == "trilinear":
        assert float(unmixed.abs().max()) == 0.0
    assert float(unmixed.abs().max()) < 1e-9
    assert float(hessian.abs().max()) > 0.1


@pytest.mark.parametrize("kind", ["smoothstep-softplus", "cubic"])
def test_smooth_fields_have_curvature(kind):
    _, _, hessian = made(kind).value_gradient_hessian(scattered(200))
    assert float(torch.diagonal(hessian, dim1=1, dim2=2).abs().median()) > 0.1


def faces(field):
    """Places that lie exactly on an axial face of some cell."""
    if isinstance(field, InterpolatedField):
        axial = torch.arange(1, SHAPE[1] - 1, dtype=torch.float64) * (2 / (SHAPE[1] - 1)) - 1
    else:
        scale = field.model.grid.grid_levels[-1].scale[1]
        axial = (torch.arange(1, int(scale), dtype=torch.float64) - 0.5) / scale * 2 - 1
    points = scattered(len(axial), seed=4)
    points[:, 1] = axial
    return points


def test_values_are_continuous_at_cell_faces_and_the_far_cell_gives_the_derivative(kind):
    field, step = made(kind), 1e-9
    points = faces(field)
    shift = torch.tensor([0, step, 0], dtype=torch.float64)
    torch.testing.assert_close(field.evaluate(points - shift), field.evaluate(points + shift), rtol=0, atol=1e-6)
    beyond = points + 1e3 * shift
    _, there = field.axial_value_and_slope(*(points + shift).unbind(-1))
    _, further = field.axial_value_and_slope(*beyond.unbind(-1))
    torch.testing.assert_close(there, further, rtol=1e-3, atol=1e-3)
    _, before = field.axial_value_and_slope(*(points - shift).unbind(-1))
    jump = float((there - before).abs().max())
    if kind in ("smoothstep-softplus", "cubic"):
        assert jump < 1e-4
    else:
        assert jump > 0.1


def test_a_spline_has_a_continuous_second_derivative():
    field, step = made("cubic"), 1e-9
    shift = torch.tensor([0, step, 0], dtype=torch.float64)
    ahead, behind = (field.value_gradient_hessian(faces(field) + sign * shift)[2] for sign in (1, -1))
    torch.testing.assert_close(ahead, behind, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("out", [axes for n in (1, 2, 3) for axes in itertools.combinations(range(3), n)])
def test_outside_the_cube_the_nearest_point_answers_and_no_derivative_points_outwards(kind, out):
    field = made(kind)
    points = scattered(50, seed=5, reach=0.9)
    points[:, list(out)] = points[:, list(out)].sign() * 1.3
    value, gradient, hessian = field.value_gradient_hessian(points)
    torch.testing.assert_close(value, field.evaluate(points.clamp(-1, 1)))
    kept = [axis for axis in range(3) if axis not in out]
    for axis in out:
        assert float(gradient[:, axis].abs().max()) == 0.0
        assert float(hessian[:, axis].abs().max()) == 0.0
    if kept:
        assert float(gradient[:, kept].abs().max()) > 0.01
    _, slope = field.axial_value_and_slope(*points.unbind(-1))
    torch.testing.assert_close(slope, gradient[:, 1], rtol=1e-5, atol=1e-5)


def test_many_threads_get_the_same_answers(field):
    points = scattered(3000, device=field.device)
    depth = points[:, :1] + torch.linspace(-0.2, 0.2, 9, dtype=torch.float64, device=field.device)

    def everything(_):
        return (
            field.evaluate(points),
            *field.axial_value_and_slope(*points.unbind(-1)),
            *field.value_gradient_hessian(points[:300]),
            field.axial_lines(points[:, 0], points[:, 2], depth),
            field.lattice(points[:7, 0], points[:8, 1], points[:9, 2]),
        )

    expected = everything(None)
    with ThreadPoolExecutor(8) as pool:
        for answers in pool.map(everything, range(16)):
            for answer, reference in zip(answers, expected, strict=True):
                torch.testing.assert_close(answer, reference, rtol=1e-9, atol=1e-9)


def test_chunks_do_not_show(kind, monkeypatch):
    field, points = made(kind), scattered(300)
    depth = points[:, :1] + torch.linspace(-0.2, 0.2, 9, dtype=torch.float64)

    def everything():
        return (
            field.evaluate(points),
            *field.value_gradient_hessian(points),
            *field.axial_value_and_slope(*points.unbind(-1)),
            field.axial_lines(points[:, 0], points[:, 2], depth),
            field.lattice(*(torch.linspace(-1, 1, n, dtype=torch.float64) for n in (5, 6, 7))),
        )

    whole = everything()
    monkeypatch.setattr("octn_ros.field.field.CHUNK_POINTS", 37)
    monkeypatch.setattr("octn_ros.field.interpolated._CHUNK", 37)
    if isinstance(field, NeuralField):
        field._chunk = 37
    for got, expected in zip(everything(), whole, strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)
