import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from octn_ros.errors import VolumeError
from octn_ros.volume import OCT_FRAME, VolumeGeometry

GEOMETRY = VolumeGeometry((5, 7, 9), (28e-6, 14.59e-6, 14e-6), (1e-3, -2e-3, 3e-3))


def test_voxel_order_becomes_oct_frame_order():
    # One step along each array axis moves along the axis that the conventions name.
    origin = GEOMETRY.voxel_to_metric(np.zeros(3))
    np.testing.assert_allclose(origin, [1e-3, -2e-3, 3e-3])
    for step, expected in (([1, 0, 0], [0, 28e-6, 0]), ([0, 1, 0], [0, 0, 14.59e-6]), ([0, 0, 1], [14e-6, 0, 0])):
        np.testing.assert_allclose(GEOMETRY.voxel_to_metric(np.array(step, float)) - origin, expected, atol=1e-15)


def test_canonical_corners_are_voxel_centres():
    index = np.array([[0, 0, 0], [4, 6, 8], [2, 3, 4]], float)
    np.testing.assert_allclose(GEOMETRY.voxel_to_canonical(index), [[-1] * 3, [1] * 3, [0] * 3], atol=1e-12)


def test_canonical_order_is_lateral_axial_bscan():
    moved = GEOMETRY.voxel_to_canonical(np.array([1.0, 0.0, 0.0])) + 1.0
    np.testing.assert_allclose(moved, [0, 0, 2 / 4])
    moved = GEOMETRY.voxel_to_canonical(np.array([0.0, 1.0, 0.0])) + 1.0
    np.testing.assert_allclose(moved, [0, 2 / 6, 0])


@given(st.tuples(*[st.floats(-10, 10)] * 3))
def test_maps_invert_each_other(index):
    index = np.array(index)
    back = GEOMETRY.canonical_to_voxel(GEOMETRY.voxel_to_canonical(index))
    np.testing.assert_allclose(back, index, atol=1e-9)
    back = GEOMETRY.metric_to_voxel(GEOMETRY.voxel_to_metric(index))
    np.testing.assert_allclose(back, index, atol=1e-6)
    point = GEOMETRY.canonical_to_metric(GEOMETRY.voxel_to_canonical(index))
    np.testing.assert_allclose(GEOMETRY.metric_to_canonical(point), GEOMETRY.voxel_to_canonical(index), atol=1e-9)


def test_torch_and_numpy_agree_and_differentiate():
    points = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    metric = GEOMETRY.canonical_to_metric(points)
    np.testing.assert_allclose(metric.detach().numpy(), GEOMETRY.canonical_to_metric(points.detach().numpy()))
    (gradient,) = torch.autograd.grad(metric[:, 2].sum(), points)
    # Canonical axial is the second coordinate and becomes z.
    np.testing.assert_allclose(gradient[0].numpy(), [0, GEOMETRY.metres_per_canonical[1], 0])


def test_extent():
    np.testing.assert_allclose(GEOMETRY.extent_m, [8 * 14e-6, 4 * 28e-6, 6 * 14.59e-6])
    assert GEOMETRY.frame == OCT_FRAME


@pytest.mark.parametrize("shape", [(1, 4, 4), (4, 1, 4), (4, 4, 1), (0, 4, 4)])
def test_short_axis_is_refused(shape):
    with pytest.raises(VolumeError, match="at least 2 voxels"):
        VolumeGeometry(shape, (1e-5, 1e-5, 1e-5))


@pytest.mark.parametrize("bad", [0.0, -1e-5, float("nan"), float("inf")])
def test_bad_spacing_is_refused(bad):
    with pytest.raises(VolumeError, match="positive spacings"):
        VolumeGeometry((4, 4, 4), (1e-5, bad, 1e-5))


@pytest.mark.parametrize("scale", [1.0, 1e-3], ids=["micrometres", "nanometres"])
def test_grids_are_the_same_in_shape_and_relative_spacing_wherever_they_lie(scale):
    spacing = tuple(s * scale for s in GEOMETRY.spacing_m)
    geometry = dataclasses.replace(GEOMETRY, spacing_m=spacing)
    assert geometry.same_grid(dataclasses.replace(geometry, origin_m=(1.0, 2.0, 3.0), frame="elsewhere"))
    for axis in range(3):
        for factor, same in ((1.0005, True), (0.9995, True), (1.002, False), (0.998, False)):
            changed = list(spacing)
            changed[axis] *= factor
            assert geometry.same_grid(dataclasses.replace(geometry, spacing_m=tuple(changed))) is same
        shape = list(geometry.shape)
        shape[axis] += 1
        assert not geometry.same_grid(dataclasses.replace(geometry, shape=tuple(shape)))
