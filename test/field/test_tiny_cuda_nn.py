"""The optional back end of tiny-cuda-nn, held against a stand-in that computes what its sources publish.

The stand-in shows that parameters find their places and that the parts are wired; tiny-cuda-nn itself needs a GPU.
"""

import dataclasses
import importlib.machinery
import itertools
import math
import sys
import types

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
    backend,
)
from octn_ros.field.cuda.tiny_cuda_nn import TinyCudaEncoding, is_tied, why_not_published
from octn_ros.field.hash_grid import HashGrid
from octn_ros.training import FitConfig, fit
from octn_ros.volume import Volume, VolumeGeometry

SHAPE = (40, 40, 40)
# Levels of 4^3, 7^3, 13^3 and 22^3 vertices there; the last two are hashed.
GRID = HashGridConfig(levels=4, features=2, log2_table_size=10, base_resolution=4, finest_ratio=0.55)
CONFIG = NeuralFieldConfig(GRID, NetworkConfig(1, 16))


class Encoding(torch.nn.Module):
    """kernel_grid, pos_fract and grid_index of tiny-cuda-nn's grid.h and common_device.h, vertex by vertex."""

    def __init__(self, n_input_dims, encoding_config, seed=1337, dtype=None):
        super().__init__()
        assert (n_input_dims, dtype, encoding_config["otype"]) == (3, torch.float32, "HashGrid")
        self.config, self.levels, rows = encoding_config, [], 0
        for level in range(encoding_config["n_levels"]):
            scale = encoding_config["per_level_scale"] ** level * encoding_config["base_resolution"] - 1.0
            resolution = math.ceil(scale - 1e-5) + 1
            size = min((resolution**3 + 7) // 8 * 8, 2 ** encoding_config["log2_hashmap_size"])
            self.levels.append((scale, resolution, size, rows))
            rows += size
        self.params = torch.nn.Parameter(torch.zeros(rows * encoding_config["n_features_per_level"]))

    def forward(self, unit):
        table = self.params.view(-1, self.config["n_features_per_level"])
        features = []
        for scale, resolution, size, first in self.levels:
            position = unit * scale + 0.5
            cell = position.detach().floor()
            share = position - cell
            if self.config["interpolation"] == "Smoothstep":
                share = share * share * (3 - 2 * share)
            total = 0.0
            for corner in itertools.product((0, 1), repeat=3):
                far = torch.tensor(corner)
                weight = torch.where(far == 1, share, 1 - share).prod(dim=1)
                x, y, z = (cell.long() + far).T
                index = x + y * resolution + z * resolution**2
                if size < resolution**3:
                    index = x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)
                total = total + weight[:, None] * table[first + index % size]
            features.append(total)
        return torch.cat(features, dim=1)


@pytest.fixture
def installed(monkeypatch):
    module = types.ModuleType("tinycudann")
    module.Encoding, module.__spec__ = Encoding, importlib.machinery.ModuleSpec("tinycudann", None)
    monkeypatch.setitem(sys.modules, "tinycudann", module)
    monkeypatch.setattr(backend, "_why_not_cuda", lambda model: "")


def random_model(config=CONFIG):
    torch.manual_seed(0)
    model = NeuralModel(config, SHAPE)
    with torch.no_grad():
        model.grid.table.uniform_(-1.0, 1.0)
    return model


def points_up_to_the_far_faces():
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    points[:100] = points[:100].sign() * (1 - 0.02 * points[:100].abs())
    points[:8] = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)))
    return points


def field_of(model, name):
    description = FieldDescription("neural", VolumeGeometry(SHAPE, (1e-5, 1e-5, 1e-5)), (0.0, 1.0), "log")
    return NeuralField(model, CONFIG, description, name)


@pytest.mark.parametrize("interpolation", ["linear", "smoothstep"])
def test_a_tied_grid_is_the_same_up_to_the_far_faces(installed, interpolation):
    grid = HashGrid(HashGridConfig(**(vars(GRID) | {"interpolation": interpolation})), SHAPE)
    with torch.no_grad():
        grid.table.uniform_(-1.0, 1.0)
    theirs, points = TinyCudaEncoding(grid), points_up_to_the_far_faces()
    assert {level.dense for level in grid.grid_levels} == {True, False}
    assert not is_tied(grid)
    assert (theirs(points) - grid(points)).abs().max() > 0.1
    theirs.tie()
    assert is_tied(grid)
    torch.testing.assert_close(theirs(points), grid(points), rtol=1e-4, atol=1e-4)


def test_every_row_that_is_read_there_finds_its_place_here_and_back(installed):
    grid = HashGrid(GRID, SHAPE)
    for part, (_, resolution, size, _) in zip(
        TinyCudaEncoding(grid).levels, Encoding(3, _encoding_config(), dtype=torch.float32).levels, strict=True
    ):
        rows = torch.arange(1, size + 1, dtype=torch.float32)[:, None].expand(-1, 2)
        table = torch.zeros_like(grid.table)
        table[part.level.first_row : part.level.first_row + part.level.size] = part.from_published(rows)
        back = part.to_published(table)
        read = min(resolution**3, size)
        assert torch.equal(back[:read], rows[:read])
        assert part.rows == size


def _encoding_config():
    return {
        "otype": "HashGrid", "n_levels": 4, "n_features_per_level": 2, "log2_hashmap_size": 10, "base_resolution": 4,
        "per_level_scale": (22 / 4) ** (1 / 3), "interpolation": "Linear",
    }  # fmt: skip


def test_gradients_are_those_of_the_rows_there_and_keep_tied_vertices_tied(installed):
    model = random_model()
    grid, points = model.grid, points_up_to_the_far_faces().requires_grad_(True)
    theirs = TinyCudaEncoding(grid)
    theirs.tie()
    weights = torch.rand(len(points), grid.width, generator=torch.Generator().manual_seed(2))
    by_points, by_table = torch.autograd.grad((theirs(points) * weights).sum(), (points, grid.table))
    rows = [part.to_published(grid.table.detach()).requires_grad_(True) for part in theirs.levels]
    ours = torch.cat([part.from_published(row) for part, row in zip(theirs.levels, rows, strict=True)])
    features = torch.func.functional_call(grid, {"table": ours}, (points,))
    expected, *by_rows = torch.autograd.grad((features * weights).sum(), (points, *rows))
    torch.testing.assert_close(by_points, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))
    parts = [part.from_published(row) for part, row in zip(theirs.levels, by_rows, strict=True)]
    torch.testing.assert_close(by_table, torch.cat(parts), rtol=1e-3, atol=1e-4 * float(by_table.abs().max()))


def test_a_fit_keeps_far_faces_tied_and_either_back_end_answers_for_it(installed):
    array = torch.rand(SHAPE, generator=torch.Generator().manual_seed(0)).numpy()
    volume = Volume.from_array(array, (1e-5, 1e-5, 1e-5))
    config = FitConfig(field=CONFIG, steps=20, batch=512, backend="tiny-cuda-nn")
    result = fit(volume, config)
    model = result.field.model
    assert result.field.description.training["backend"] == "tiny-cuda-nn"
    # First features are nearly zero, so tying the far faces hardly changes where a fit goes.
    assert result.psnr_db == pytest.approx(fit(volume, dataclasses.replace(config, backend="torch")).psnr_db, abs=0.02)
    assert is_tied(model.grid)
    assert float(model.grid.table.abs().max()) > 1e-3
    fast, plain = field_of(model, "tiny-cuda-nn"), field_of(model, "torch")
    assert (fast.backend, plain.backend) == ("tiny-cuda-nn", "torch")
    points = points_up_to_the_far_faces()
    axis = torch.linspace(-1, 1, 9)
    for ask in (
        lambda field: field.evaluate(points),
        lambda field: field.value_and_gradient(points[100:])[1],
        lambda field: field.lattice(axis, axis[:3], axis[-2:]),
        lambda field: field.axial_lines(axis, axis, axis[:, None].repeat(1, 2)),
    ):
        expected = ask(plain)
        torch.testing.assert_close(ask(fast), expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))
    assert fast.evaluate(points[:0]).shape == (0,)


def test_a_field_of_its_own_far_faces_is_left_to_the_reference(installed):
    with pytest.warns(BackendWarning, match=r"tiny-cuda-nn.*far faces are its own.*fit it by that backend"):
        assert field_of(random_model(), "tiny-cuda-nn").backend == "torch"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"features": 3}, "3 features per level; tiny-cuda-nn has 1, 2, 4, 8"),
        ({"cells_per_bscan": 0.5}, "cells along the axes; tiny-cuda-nn would have"),
        ({"log2_table_size": 6}, "level 0 just misses the table of 2^6 rows"),
    ],
)
def test_grids_that_it_does_not_have(change, reason):
    assert reason in why_not_published(HashGrid(HashGridConfig(**(vars(GRID) | change)), SHAPE))
    assert why_not_published(HashGrid(GRID, SHAPE)) == ""


class EncodingOfAnotherLayout(Encoding):
    def __init__(self, *arguments, **named):
        super().__init__(*arguments, **named)
        self.params = torch.nn.Parameter(torch.zeros(7))


def test_a_version_of_another_layout_is_refused(installed, monkeypatch):
    monkeypatch.setattr(sys.modules["tinycudann"], "Encoding", EncodingOfAnotherLayout)
    with pytest.raises(ConfigurationError, match="parameters of tiny-cuda-nn's encoding, got 7"):
        TinyCudaEncoding(HashGrid(GRID, SHAPE))


def test_without_the_library_plain_torch_answers(monkeypatch):
    monkeypatch.setattr(backend, "_why_not_cuda", lambda model: "")
    monkeypatch.setattr(backend.importlib.util, "find_spec", lambda name: None)
    with pytest.warns(BackendWarning, match="tinycudann is missing"):
        assert field_of(random_model(), "tiny-cuda-nn").backend == "torch"
