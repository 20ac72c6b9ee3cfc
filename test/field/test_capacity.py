import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from octn_ros.errors import ConfigurationError
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.field.capacity import MOST_PARAMETERS, bits_per_voxel, grid_for_volume
from octn_ros.volume import VolumeGeometry

SPACING = (28e-6, 14.59e-6, 14e-6)
shapes = st.tuples(st.integers(48, 512), st.integers(48, 1024), st.integers(48, 1024))


def resolved(shape, bits, features=4, **others):
    config = NeuralFieldConfig(HashGridConfig(features=features, **others), NetworkConfig(1, 8), bits_per_voxel=bits)
    return config.for_volume(VolumeGeometry(shape, SPACING))


def parameters(config, shape):
    """Numbers in the tables of a model that is described, not allocated."""
    with torch.device("meta"):
        return NeuralModel(config, shape).grid.table.numel()


@given(shapes, st.floats(4.0, 24.0), st.sampled_from([2, 4]))
@settings(max_examples=50, deadline=None)
def test_bits_per_voxel_hold_for_any_volume(shape, bits, features):
    config = resolved(shape, bits, features)
    table = parameters(config, shape)
    assert table <= MOST_PARAMETERS
    expected = min(bits, MOST_PARAMETERS * 32 / math.prod(shape))
    got = table * 32 / math.prod(shape)
    assert got == pytest.approx(bits_per_voxel(config.grid, shape))
    # An axis of 48 voxels has some 12 vertices: they come one by one.
    assert 0.8 * expected < got <= expected * (1 + 1e-9)


@given(st.tuples(*[st.integers(2, 4000)] * 3), st.floats(0.01, 64.0), st.sampled_from([1, 2, 16]))
@settings(max_examples=50, deadline=None)
def test_no_volume_takes_more_than_the_memory_limit(shape, bits, features):
    config = resolved(shape, bits, features)
    # The fewest vertices that a grid can have: two levels of 3 along each axis.
    assert parameters(config, shape) <= max(MOST_PARAMETERS, 2 * 27 * features)


@pytest.mark.parametrize("shape", [(256, 512, 512), (512, 1024, 1024)])
def test_every_vertex_of_a_large_volume_has_a_row_of_its_own(shape):
    config = resolved(shape, 16.0)
    with torch.device("meta"):
        levels = NeuralModel(config, shape).grid.grid_levels
    assert all(level.dense for level in levels)
    cells_per_voxel = [(scale + 1) / n for scale, n in zip(levels[-1].scale, reversed(shape), strict=True)]
    assert cells_per_voxel == pytest.approx([0.47] * 3, abs=0.03)
    growth = levels[-1].scale[0] / levels[-2].scale[0]
    assert 1.5 < growth < 2.8


def test_resolution_and_levels_grow_with_the_volume():
    configs = [resolved((n, 2 * n, 2 * n), 16.0) for n in (32, 64, 128, 256)]
    levels = [config.grid.levels for config in configs]
    tables = [config.grid.log2_table_size for config in configs]
    assert levels == sorted(levels)
    assert levels[-1] > levels[0]
    # Eight times the voxels, eight times the rows.
    assert [b - a for a, b in itertools.pairwise(tables)] == [3, 3, 3]


def test_a_resolved_configuration_resolves_to_itself():
    config = resolved((64, 80, 128), 8.0)
    assert config.bits_per_voxel == 0.0
    assert config.for_volume(VolumeGeometry((512, 512, 512), SPACING)) is config


def test_what_is_not_asked_for_stays():
    config = resolved((64, 80, 128), 8.0, features=2, interpolation="smoothstep")
    assert (config.grid.features, config.grid.interpolation, config.network.neurons) == (2, "smoothstep", 8)


@pytest.mark.parametrize("bits", [-1.0, float("nan"), 65.0])
def test_bits_out_of_range_are_refused(bits):
    with pytest.raises(ConfigurationError, match="bits_per_voxel"):
        NeuralFieldConfig(bits_per_voxel=bits)


def test_a_grid_needs_some_bits():
    with pytest.raises(ConfigurationError, match="expected more than 0"):
        grid_for_volume(HashGridConfig(), (8, 8, 8), 0.0)
