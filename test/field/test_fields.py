import numpy as np
import pytest
import torch

from octn_ros.field import (
    FieldDescription,
    HashGridConfig,
    InterpolatedField,
    NetworkConfig,
    NeuralField,
    NeuralFieldConfig,
    NeuralModel,
)
from octn_ros.volume import Volume

SPACING = (28e-6, 14.59e-6, 14e-6)
CONFIG = NeuralFieldConfig(HashGridConfig(levels=3, features=2, log2_table_size=10), NetworkConfig(2, 16))


@pytest.fixture
def volume():
    rng = np.random.default_rng(2)
    return Volume.from_array(rng.integers(0, 256, (6, 7, 8), dtype=np.uint8), SPACING, stamp_ns=7)


def neural(volume):
    torch.manual_seed(0)
    model = NeuralModel(CONFIG, volume.geometry.shape)
    with torch.no_grad():
        model.grid.table.uniform_(-1, 1)
    return NeuralField(model, CONFIG, FieldDescription.of_volume(volume, "neural"))


@pytest.fixture(params=["neural", "interpolated"])
def field(request, volume):
    return neural(volume) if request.param == "neural" else InterpolatedField(volume)


def scattered(count=500, seed=0):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_interpolated_field_passes_through_the_voxels(volume):
    field = InterpolatedField(volume)
    index = torch.cartesian_prod(*(torch.arange(n) for n in volume.geometry.shape)).float()
    values = field.evaluate(volume.geometry.voxel_to_canonical(index))
    np.testing.assert_allclose(values.numpy(), volume.normalized().ravel(), atol=2e-6)


def test_interpolated_field_is_linear_between_voxels(volume):
    field, voxels = InterpolatedField(volume), volume.normalized()
    between = volume.geometry.voxel_to_canonical(torch.tensor([[2.25, 3.0, 4.0]]))
    assert float(field.evaluate(between)) == pytest.approx(0.75 * voxels[2, 3, 4] + 0.25 * voxels[3, 3, 4], abs=1e-5)


def test_interpolated_gradient_of_a_ramp():
    bscan, axial, lateral = np.meshgrid(np.arange(5.0), np.arange(6.0), np.arange(7.0), indexing="ij")
    ramp = (bscan + 2 * axial + 3 * lateral) / 100
    field = InterpolatedField(Volume.from_array(ramp, SPACING))
    _, gradient = field.value_and_gradient(scattered() * 0.99)
    expected = torch.tensor([3 * 6 / 2, 2 * 5 / 2, 4 / 2]) / 100
    torch.testing.assert_close(gradient, expected.expand_as(gradient), rtol=1e-4, atol=1e-5)


def test_value_and_gradient_agree_with_evaluate(field):
    points = scattered().requires_grad_(True)
    value = field.evaluate(points)
    (expected,) = torch.autograd.grad(value.sum(), points)
    got_value, got_gradient = field.value_and_gradient(points)
    torch.testing.assert_close(got_value, value.detach())
    torch.testing.assert_close(got_gradient, expected)
    assert not got_gradient.requires_grad


def test_gradient_works_inside_no_grad_and_for_no_points(field):
    with torch.no_grad():
        _, gradient = field.value_and_gradient(scattered(3))
    assert gradient.shape == (3, 3)
    value, gradient = field.value_and_gradient(torch.zeros(0, 3))
    assert (value.shape, gradient.shape) == ((0,), (0, 3))


def test_lattice_equals_points(field, monkeypatch):
    monkeypatch.setattr("octn_ros.field.field.CHUNK_POINTS", 11)
    lateral, axial, bscan = torch.linspace(-1, 1, 5), torch.linspace(-0.9, 0.7, 4), torch.tensor([-0.3, 0.1, 0.8])
    got = field.lattice(lateral, axial, bscan)
    assert got.shape == (3, 4, 5)
    for b in range(3):
        for a in range(4):
            points = torch.stack((lateral, axial[a].expand(5), bscan[b].expand(5)), -1)
            torch.testing.assert_close(got[b, a], field.evaluate(points).detach(), rtol=1e-5, atol=1e-6)


def test_outside_the_scan_the_nearest_point_answers(field):
    outside = torch.tensor([[1.7, 0.1, 0.2], [0.0, -5.0, 9.0]])
    torch.testing.assert_close(field.evaluate(outside), field.evaluate(outside.clamp(-1, 1)))


def test_description_travels(field, volume):
    assert field.geometry == volume.geometry
    assert field.description.stamp_ns == 7
    assert field.description.intensity_range == (0.0, 255.0)
    assert field.kind == field.description.kind
    assert field.device == torch.device("cpu")


def test_a_field_is_read_only(volume):
    field = neural(volume)
    assert not any(parameter.requires_grad for parameter in field.model.parameters())
