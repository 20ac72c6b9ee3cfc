import numpy as np
import pytest
import torch

from octn_ros.field import InterpolatedField, MetricField
from octn_ros.volume import Volume

SPACING = (28e-6, 14.59e-6, 14e-6)
ORIGIN = (1e-3, -2e-3, 3e-3)


@pytest.fixture(params=["trilinear", "cubic"])
def field(request):
    array = np.random.default_rng(1).random((7, 9, 8))
    return InterpolatedField(Volume.from_array(array, SPACING, origin_m=ORIGIN), order=request.param)


def places(field, count=200):
    unit = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.98 + 0.01
    return torch.tensor(ORIGIN) + unit * torch.tensor(field.geometry.extent_m, dtype=torch.float64)


def test_voxel_centres_keep_their_intensities(field):
    index = torch.tensor([[0.0, 0, 0], [6, 8, 7], [3, 2, 5]], dtype=torch.float64)
    values = MetricField(field).evaluate(field.geometry.voxel_to_metric(index))
    voxels = field.volume.normalized()
    np.testing.assert_allclose(values.numpy(), [voxels[0, 0, 0], voxels[6, 8, 7], voxels[3, 2, 5]], atol=1e-6)


def test_gradient_per_metre_matches_differences(field):
    metric, points, step = MetricField(field), places(field), 1e-11
    value, gradient = metric.value_and_gradient(points)
    torch.testing.assert_close(value, metric.evaluate(points))
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        difference = (metric.evaluate(points + shift) - metric.evaluate(points - shift)) / (2 * step)
        torch.testing.assert_close(gradient[:, axis], difference, rtol=1e-3, atol=3.0)


def test_hessian_of_a_product_ramp():
    """f = x y + 2 y z + 3 z x in scaled metres: trilinear interpolation reproduces it, mixed derivatives included."""
    bscan, axial, lateral = np.meshgrid(*(np.arange(n) for n in (5, 6, 7)), indexing="ij")
    x, y, z = lateral * 14e-6 * 1e3, bscan * 28e-6 * 1e3, axial * 14.59e-6 * 1e3
    array = x * y + 2 * y * z + 3 * z * x
    volume = Volume.from_array(array, SPACING, origin_m=ORIGIN, intensity_range=(0.0, 1.0))
    field = InterpolatedField(volume)
    _, _, hessian = MetricField(field).value_gradient_hessian(places(field))
    expected = torch.tensor([[0, 1, 3], [1, 0, 2], [3, 2, 0]], dtype=torch.float64) * 1e6
    torch.testing.assert_close(hessian, expected.expand_as(hessian), rtol=1e-3, atol=1e3)


def test_lattice_equals_points(field):
    metric = MetricField(field)
    x, y, z = (places(field, n)[:, axis].sort().values for axis, n in enumerate((4, 5, 6)))
    slow, middle, fast = torch.meshgrid(y, z, x, indexing="ij")
    expected = metric.evaluate(torch.stack((fast, slow, middle), -1).view(-1, 3)).view(slow.shape)
    torch.testing.assert_close(metric.lattice(x, y, z), expected, rtol=1e-6, atol=1e-6)


def test_outside_the_box_the_nearest_point_answers(field):
    metric = MetricField(field)
    outside = places(field, 3) + torch.tensor([1e-2, 0, 0])
    nearest = outside.clone()
    nearest[:, 0] = ORIGIN[0] + field.geometry.extent_m[0]
    torch.testing.assert_close(metric.evaluate(outside), metric.evaluate(nearest))
    assert float(metric.value_and_gradient(outside)[1][:, 0].abs().max()) == 0.0
    assert metric.geometry == field.geometry
    assert metric.device == torch.device("cpu")
