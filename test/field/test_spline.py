"""Cubic B-splines against volumes whose derivatives are known."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from octn_ros.errors import ConfigurationError
from octn_ros.field import InterpolatedField, MetricField
from octn_ros.volume import Volume

SPACING = (28e-6, 14.59e-6, 14e-6)


def noise(shape=(6, 7, 8), seed=2):
    return Volume.from_array(np.random.default_rng(seed).random(shape), SPACING)


def axes(shape, spacing=SPACING):
    """Metric coordinates in tens of micrometres, arrays [bscan, axial, lateral]."""
    return np.meshgrid(*(np.arange(n) * s * 1e5 for n, s in zip(shape, spacing, strict=True)), indexing="ij")


def middle(volume, margin_voxels, count=200):
    """Points at least some voxels away from the outer faces, where the mirror at the boundary no longer shows."""
    shape = torch.tensor(volume.geometry.shape, dtype=torch.float64)
    unit = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    index = margin_voxels + unit * (shape - 1 - 2 * margin_voxels)
    return volume.geometry.voxel_to_metric(index)


@pytest.mark.parametrize("shape", [(6, 7, 8), (2, 2, 2), (2, 3, 40)])
def test_the_spline_passes_through_the_voxels(shape):
    volume = noise(shape)
    field = InterpolatedField(volume, order="cubic")
    index = torch.cartesian_prod(*(torch.arange(n) for n in shape)).double()
    values = field.evaluate(volume.geometry.voxel_to_canonical(index))
    np.testing.assert_allclose(values.numpy(), volume.normalized().ravel(), atol=3e-6)
    lattice = field.lattice(*(torch.linspace(-1, 1, shape[axis], dtype=torch.float64) for axis in (2, 1, 0)))
    np.testing.assert_allclose(lattice.numpy(), volume.normalized(), atol=3e-6)


def test_the_spline_is_scipys():
    """scipy evaluates the same spline, boundary included, by its own code."""
    volume = noise()
    index = torch.rand(300, 3, dtype=torch.float64) * (torch.tensor(volume.geometry.shape) - 1)
    expected = ndimage.map_coordinates(
        volume.normalized().astype(np.float64), index.numpy().T, order=3, mode="mirror", prefilter=True
    )
    got = InterpolatedField(volume, order="cubic").evaluate(volume.geometry.voxel_to_canonical(index))
    np.testing.assert_allclose(got.numpy(), expected, atol=3e-6)


def test_a_quadratic_keeps_its_gradient_and_its_hessian():
    shape = (40, 44, 48)
    y, z, x = axes(shape)
    matrix = np.array([[0.4, -0.1, 0.2], [-0.1, 0.3, 0.05], [0.2, 0.05, -0.5]])
    slope = np.array([1.0, -2.0, 0.5])
    where = np.stack((x, y, z), -1)
    array = 0.5 * np.einsum("...i,ij,...j->...", where, matrix, where) + where @ slope
    volume = Volume.from_array(array.astype(np.float32), SPACING)
    low, high = volume.intensity_range
    points = middle(volume, margin_voxels=14)
    _, gradient, hessian = MetricField(InterpolatedField(volume, order="cubic")).value_gradient_hessian(points)
    scale = (high - low) / 1e5
    expected = points.numpy() * 1e5 @ matrix + slope
    np.testing.assert_allclose(gradient.numpy() * scale, expected, rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(hessian.numpy() * scale / 1e5, np.broadcast_to(matrix, (200, 3, 3)), atol=5e-3)


def test_the_distance_to_a_sphere_has_the_spheres_curvature():
    """The Hessian of a distance is the projector across its gradient over the radius: principal curvatures 1 / R."""
    shape = (44, 80, 84)
    y, z, x = axes(shape)
    centre = np.array([x.mean(), y.mean(), -200.0])
    distance = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2)
    volume = Volume.from_array(distance.astype(np.float32), SPACING)
    low, high = volume.intensity_range
    points = middle(volume, margin_voxels=14)
    _, gradient, hessian = MetricField(InterpolatedField(volume, order="cubic")).value_gradient_hessian(points)
    gradient, hessian = gradient.numpy() * (high - low) / 1e5, hessian.numpy() * (high - low) / 1e10
    away = points.numpy() * 1e5 - centre
    radius = np.linalg.norm(away, axis=1)
    normal = away / radius[:, None]
    np.testing.assert_allclose(gradient, normal, atol=2e-4)
    expected = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / radius[:, None, None]
    # Within 4 % of 1 / R: float32 voxels leave some 1e-7 of the range, divided by the square of a voxel.
    np.testing.assert_allclose(hessian, expected, atol=0.04 / radius.min())


def test_the_first_derivative_vanishes_on_the_outer_faces():
    field = InterpolatedField(noise(), order="cubic")
    points = torch.rand(50, 3, dtype=torch.float64) * 2 - 1
    for axis in range(3):
        on_face = points.clone()
        on_face[:, axis] = on_face[:, axis].sign()
        _, gradient = field.value_and_gradient(on_face)
        assert float(gradient[:, axis].abs().max()) < 1e-4


def test_an_unknown_order_is_refused():
    with pytest.raises(ConfigurationError, match="order: expected trilinear or cubic, got 'quintic'"):
        InterpolatedField(noise(), order="quintic")
