import math

import pytest
import torch

from octn_ros.errors import ConfigurationError
from octn_ros.field import FieldDescription, NetworkConfig, NeuralField, NeuralFieldConfig, NeuralModel
from octn_ros.field.grid_level import GridLevel
from octn_ros.field.hash_grid import HashGrid, HashGridConfig
from octn_ros.volume import VolumeGeometry

SHAPE = (20, 30, 40)
DENSE = HashGridConfig(levels=3, features=2, log2_table_size=17, base_resolution=4)
HASHED = HashGridConfig(levels=4, features=4, log2_table_size=6, base_resolution=4)


def made(config, seed=0):
    torch.manual_seed(seed)
    grid = HashGrid(config, SHAPE).double()
    with torch.no_grad():
        grid.table.uniform_(-1, 1)
    return grid


def points(count, seed=0):
    return torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_level_scales_follow_the_published_formula():
    config = HashGridConfig(levels=5, base_resolution=16)
    scales = config.level_scales((100, 256, 256))
    growth = (256 / 16) ** (1 / 4)
    for level, scale in enumerate(scales):
        assert scale == pytest.approx((16 * growth**level - 1,) * 3)


def test_cells_follow_the_shape_when_asked():
    scales = HashGridConfig(levels=2, base_resolution=16, follow_shape=True).level_scales((20, 40, 80))
    assert scales[1] == pytest.approx((79, 39, 19))


def test_paper_preset_stores_what_the_paper_says():
    with torch.device("meta"):
        grid = HashGrid(HashGridConfig(), (256, 512, 512))
    assert grid.width == 48
    hashed = [level for level in grid.grid_levels if not level.dense]
    assert hashed
    assert all(level.size == 2**20 for level in hashed)


def test_dense_vertices_are_distinct_rows():
    grid = made(DENSE)
    corners = torch.tensor([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], dtype=torch.float64)
    for level in grid.grid_levels:
        assert level.dense
        rows, _ = level.corners((corners + 1) / 2)
        assert rows.min() >= level.first_row
        assert rows.max() < level.first_row + level.size
    axis = (torch.arange(int(DENSE.base_resolution)) + 0.0) / (DENSE.base_resolution - 1)
    lattice = torch.cartesian_prod(axis, axis, axis).double()
    rows, _ = grid.grid_levels[0].corners(lattice)
    assert rows.unique().numel() == math.prod(grid.grid_levels[0].vertices)


def test_weights_are_a_partition_of_unity():
    _, weights = made(HASHED)._rows_and_weights(points(100))
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(400, dtype=torch.float64))


@pytest.mark.parametrize("config", [DENSE, HASHED])
def test_fused_path_equals_the_reference_in_values_and_table_gradients(config):
    grid, where = made(config), points(300)
    fused = grid(where)
    reference = grid(where.clone().requires_grad_(True))
    torch.testing.assert_close(fused, reference, rtol=1e-12, atol=1e-12)
    weights = torch.rand_like(fused)
    (by_fused,) = torch.autograd.grad((fused * weights).sum(), grid.table)
    (by_reference,) = torch.autograd.grad((reference * weights).sum(), grid.table)
    torch.testing.assert_close(by_fused, by_reference, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("config", [DENSE, HASHED])
def test_position_gradient_matches_differences_inside_cells(config):
    grid = made(config)
    where, step = points(200, seed=3), 1e-6
    # Keep to points whose neighbours at +-step lie in the same cell of every level.
    keep = torch.ones(len(where), dtype=torch.bool)
    for level in grid.grid_levels:
        position = (where + 1) / 2 * torch.tensor(level.scale) + 0.5
        keep &= ((position - position.round()).abs() > 1e-3).all(-1)
    where = where[keep].requires_grad_(True)
    assert len(where) > 100
    weights = torch.rand(grid.width, dtype=torch.float64)
    (exact,) = torch.autograd.grad((grid(where) @ weights).sum(), where)
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        with torch.no_grad():
            difference = (grid(where + shift) - grid(where - shift)) @ weights / (2 * step)
        torch.testing.assert_close(exact[:, axis], difference, rtol=1e-6, atol=1e-6)


def test_continuous_across_cell_faces():
    grid = made(HASHED)
    for level in grid.grid_levels:
        face = torch.full((1, 3), 0.3, dtype=torch.float64)
        face[0, 1] = (math.floor(level.scale[1] / 2) - 0.5) / level.scale[1] * 2 - 1
        shift = torch.tensor([0, 1e-9, 0], dtype=torch.float64)
        torch.testing.assert_close(grid(face - shift), grid(face + shift), atol=1e-6, rtol=0)


def test_outside_the_cube_the_nearest_point_answers():
    grid = made(HASHED)
    outside = torch.tensor([[1.5, 0.2, -3.0]], dtype=torch.float64)
    torch.testing.assert_close(grid(outside), grid(outside.clamp(-1, 1)))


@pytest.mark.parametrize("wrong", [{"levels": 0}, {"features": 17}, {"log2_table_size": 40}, {"finest_ratio": 0.0}])
def test_bad_shapes_are_refused(wrong):
    with pytest.raises(ConfigurationError, match=next(iter(wrong))):
        HashGridConfig(**wrong)


@pytest.mark.parametrize("config", [DENSE, HASHED])
def test_lattice_path_equals_points(config):
    grid = made(config)
    lateral, axial = torch.linspace(-1.2, 1, 7, dtype=torch.float64), torch.tensor([0.9, -0.3, 0.1]).double()
    bscan = torch.tensor([0.5, 0.5, -1.0]).double()
    got = grid.forward_lattice(lateral, axial, bscan)
    b, a, w = torch.meshgrid(bscan, axial, lateral, indexing="ij")
    expected = grid(torch.stack((w, a, b), -1).reshape(-1, 3)).detach()
    torch.testing.assert_close(got.reshape(-1, grid.width), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("below", [0.0, 1e-12, 1e-9, 1e-7, 1e-5])
@pytest.mark.parametrize("number", [1, 7, 22, 127, 1023])
def test_a_far_face_that_rounds_up_stays_in_the_table(number, below):
    """A scale just below n + 1/2 rounds to it in float32: the far face must not land in a cell that is not there."""
    level = GridLevel.fit((number + 0.5 - below,) * 3, 1 << 40, 0, smooth=False)
    for dtype in (torch.float32, torch.float64):
        rows, weights = level.corners(torch.ones(1, 3, dtype=dtype))
        assert int(rows.max()) < level.size
        torch.testing.assert_close(weights.sum(), torch.ones((), dtype=dtype))


@pytest.mark.parametrize("backend", ["torch", "auto"])
def test_odd_volumes_answer_at_their_far_faces(backend):
    """Half a cell per voxel of an odd number is such a scale; every back end must find its vertices."""
    for odd in (33, 35, 37, 39, 41, 43, 45, 129, 257):
        shape = (odd, odd, odd)
        config = NeuralFieldConfig(
            HashGridConfig(levels=3, features=4, log2_table_size=22, finest_ratio=0.5, follow_shape=True),
            NetworkConfig(1, 8),
        )
        model = NeuralModel(config, shape)
        geometry = VolumeGeometry(shape, (1e-5, 1e-5, 1e-5))
        field = NeuralField(model, config, FieldDescription("neural", geometry, (0.0, 1.0), "log"), backend=backend)
        edge = torch.tensor([-1.0, 0.0, 1.0])
        expected = field.model(torch.cartesian_prod(edge, edge, edge)).view(3, 3, 3).permute(2, 1, 0)
        torch.testing.assert_close(field.lattice(edge, edge, edge), expected, rtol=1e-4, atol=1e-5)
