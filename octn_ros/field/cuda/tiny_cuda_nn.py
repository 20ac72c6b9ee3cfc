"""A hash grid run by tiny-cuda-nn, where a user has built its PyTorch extension `tinycudann`.

Its encoding is used in float32, the network stays torch's: tiny-cuda-nn's own networks have no biases and compute in
float16. The two lay out dense levels differently. Theirs wrap around at the far faces of the cube, where several of
our vertices share one of their rows; so a field is theirs too only if those vertices hold equal features ("tied"), as
a fit through tiny-cuda-nn keeps them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from octn_ros.errors import ConfigurationError
from octn_ros.field.cuda.differentiated import DifferentiatedEvaluator
from octn_ros.field.grid_level import GridLevel
from octn_ros.field.hash_grid import HashGrid

if TYPE_CHECKING:
    from octn_ros.field.neural import NeuralModel

# What its grids are compiled for.
_FEATURES = (1, 2, 4, 8)


class PublishedLevel(NamedTuple):
    """A level as tiny-cuda-nn lays it out, and where its rows and ours are in each other's tables.

    Attributes:
        level: ours.
        rows: how many it has there.
        row_of_ours: its row there for each of our rows, of a dense level [level.size]; None if both are in order.
        ours_of_row: one of our rows for each of its rows there [rows]; None likewise.
    """

    level: GridLevel
    rows: int
    row_of_ours: Tensor | None
    ours_of_row: Tensor | None

    @classmethod
    def of(cls, level: GridLevel, scale: np.float32, capacity: int, device: torch.device) -> PublishedLevel:
        """Lay out a level of that scale as GridEncodingTemplated and grid_index of tiny-cuda-nn's grid.h do."""
        resolution = math.ceil(scale) + 1
        rows = _published_rows(resolution, capacity)
        if not level.dense:
            return cls(level, rows, None, None)
        bscan, axial, lateral = torch.meshgrid(*(torch.arange(n) for n in level.vertices[::-1]), indexing="ij")
        there = ((lateral + axial * resolution + bscan * resolution**2) % rows).flatten()
        inside = ((lateral < resolution) & (axial < resolution) & (bscan < resolution)).flatten()
        numbers = torch.arange(level.size)
        back = torch.zeros(rows, dtype=torch.int64)
        back[there] = numbers
        back[there[inside]] = numbers[inside]  # a vertex that has a row of its own there comes first
        return cls(level, rows, there.to(device), back.to(device))

    def to_published(self, table: Tensor) -> Tensor:
        """Return its rows there [rows, features] from our table."""
        ours = table[self.level.first_row : self.level.first_row + self.level.size]
        return ours if self.ours_of_row is None else ours[self.ours_of_row]

    def from_published(self, rows: Tensor) -> Tensor:
        """Return our rows [level.size, features] from its rows there."""
        return rows if self.row_of_ours is None else rows[self.row_of_ours]


class TinyCudaEncoding:
    """Encodes canonical points [N, 3] as features [N, levels * features] through tiny-cuda-nn, from our table.

    Differentiable once, in the table and in the points. The gradient by the table is that of tied features, and the
    same for all that are tied, so that gradient steps keep them tied.

    Args:
        grid: a hash grid for which `why_not_published` has no objection; its table is shared.

    Raises:
        ConfigurationError: the installed version lays its levels out in another way.
    """

    def __init__(self, grid: HashGrid) -> None:
        import tinycudann

        self.grid = grid
        config, device = grid.config, grid.table.device
        self.levels = [
            PublishedLevel.of(level, scale, 2**config.log2_table_size, device)
            for level, scale in zip(grid.grid_levels, _published_scales(grid), strict=True)
        ]
        self._module = tinycudann.Encoding(
            3,
            {
                "otype": "HashGrid",
                "n_levels": config.levels,
                "n_features_per_level": config.features,
                "log2_hashmap_size": config.log2_table_size,
                "base_resolution": config.base_resolution,
                "per_level_scale": _growth(grid),
                "interpolation": "Smoothstep" if config.interpolation == "smoothstep" else "Linear",
            },
            dtype=torch.float32,
        ).requires_grad_(False)
        expected = sum(level.rows for level in self.levels) * config.features
        if self._module.params.numel() != expected:
            raise ConfigurationError(
                f"expected {expected} parameters of tiny-cuda-nn's encoding, got {self._module.params.numel()}: its "
                "installed version lays its levels out in another way; use the backend triton"
            )

    def __call__(self, points: Tensor) -> Tensor:
        """Encode canonical points [N, 3] on the table's device."""
        if len(points) == 0:
            return points.new_zeros(0, self.grid.width)
        unit = (points.float().clamp(-1.0, 1.0) + 1.0) * 0.5
        parameters = _Published.apply(self.grid.table, self).flatten()
        features: Tensor = torch.func.functional_call(self._module, {"params": parameters}, (unit,))
        return features

    def tie(self) -> None:
        """Let our vertices that share a row there hold equal features, in place."""
        with torch.no_grad():
            for part in self.levels:
                tied = part.from_published(part.to_published(self.grid.table))
                self.grid.table[part.level.first_row : part.level.first_row + part.level.size] = tied


class TinyCudaModel:
    """A model whose encoding is run by tiny-cuda-nn and whose network by torch: what a fit differentiates.

    Args:
        model: the model; its parameters are shared, and its far faces tied, in place.
    """

    def __init__(self, model: NeuralModel) -> None:
        self._encoding, self._network = TinyCudaEncoding(model.grid), model.network
        self._encoding.tie()

    def __call__(self, points: Tensor) -> Tensor:
        """Map canonical points [N, 3] to intensities [N]."""
        values: Tensor = self._network(self._encoding(points))
        return values


class TinyCudaEvaluator(DifferentiatedEvaluator):
    """Evaluates a model, tied already, whose parameters stay as they are.

    Equal to the model itself up to rounding in the position, which tiny-cuda-nn takes from scales of its own float32
    arithmetic: some 1e-4 of a cell at the finest levels.

    Args:
        model: the fitted model; its parameters are shared.
    """

    def __init__(self, model: NeuralModel) -> None:
        super().__init__(TinyCudaModel(model))


class _Published(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, table: Tensor, encoding: TinyCudaEncoding) -> Tensor:
        ctx.levels = encoding.levels  # type: ignore[attr-defined]
        return torch.cat([level.to_published(table) for level in encoding.levels])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: torch.autograd.function.FunctionCtx, gradient: Tensor) -> tuple[Tensor, None]:
        levels: list[PublishedLevel] = ctx.levels  # type: ignore[attr-defined]
        parts = gradient.split([level.rows for level in levels])
        return torch.cat([level.from_published(part) for level, part in zip(levels, parts, strict=True)]), None


def why_not_published(grid: HashGrid) -> str:
    """Say in words why tiny-cuda-nn has no such grid, empty if it has."""
    config = grid.config
    if config.features not in _FEATURES:
        return f"it has {config.features} features per level; tiny-cuda-nn has {', '.join(map(str, _FEATURES))}"
    for number, (level, scale) in enumerate(zip(grid.grid_levels, _published_scales(grid), strict=True)):
        if any(abs(ours - scale) > 1e-5 * scale for ours in level.scale):
            return f"level {number} has {level.scale} cells along the axes; tiny-cuda-nn would have {scale:g} along all"
        resolution = math.ceil(scale) + 1
        if level.dense != (resolution**3 <= _published_rows(resolution, 2**config.log2_table_size)):
            return f"level {number} just misses the table of 2^{config.log2_table_size} rows, and fits tiny-cuda-nn's"
    return ""


def is_tied(grid: HashGrid) -> bool:
    """Say whether a grid that tiny-cuda-nn has holds equal features where rows are shared there."""
    scales = _published_scales(grid)
    for level, scale in zip(grid.grid_levels, scales, strict=True):
        part = PublishedLevel.of(level, scale, 2**grid.config.log2_table_size, grid.table.device)
        ours = grid.table[level.first_row : level.first_row + level.size]
        if not torch.equal(part.from_published(part.to_published(grid.table)), ours):
            return False
    return True


def _growth(grid: HashGrid) -> float:
    coarsest, finest = grid.grid_levels[0].scale[0] + 1.0, grid.grid_levels[-1].scale[0] + 1.0
    return float((finest / coarsest) ** (1.0 / max(len(grid.grid_levels) - 1, 1)))


def _published_scales(grid: HashGrid) -> list[np.float32]:
    """Return each level's cells per unit length as tiny-cuda-nn computes them, in float32."""
    log2_growth = np.log2(np.float32(_growth(grid)))
    base = np.float32(grid.config.base_resolution)
    return [
        np.float32(np.exp2(np.float32(level) * log2_growth) * base - np.float32(1.0))
        for level in range(grid.config.levels)
    ]


def _published_rows(resolution: int, capacity: int) -> int:
    """Return the rows of a level: all its vertices, rounded up to 8, at most the table."""
    return min(-(-(resolution**3) // 8) * 8, capacity)
