"""The multiresolution hash grid: positions in a cube become interpolated feature vectors.

Conventions of tiny-cuda-nn and of Müller et al., "Instant Neural Graphics Primitives" (2022): level l has
`scale = base * growth^l - 1` cells per unit length, positions are shifted by half a cell, levels with few enough
vertices are stored densely and the others are hashed with the published primes. One difference: a dense level owns
every vertex that its cells touch, so no vertex at the far faces is shared with another one by wrap-around.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from octn_ros.settings import check_settings, setting

_PRIMES = (1, 2654435761, 805459861)
_CORNERS = tuple((a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1))


@dataclass(frozen=True)
class HashGridConfig:
    """Shape of the encoding. The defaults are the paper's; what the paper leaves open says so."""

    levels: int = setting(24, "number of resolution levels", low=1, high=32)
    features: int = setting(2, "features per level", low=1, high=16)
    log2_table_size: int = setting(20, "logarithm of the largest number of vertices stored per level", low=4, high=24)
    base_resolution: int = setting(16, "cells along the longest axis at the coarsest level", low=2, high=4096)
    finest_ratio: float = setting(
        1.0, "cells of the finest level per voxel along the longest axis (open in the paper)", low=0.05, high=4.0
    )
    follow_shape: bool = setting(
        False, "whether each axis has cells in proportion to its voxels (open in the paper; else a cube)"
    )

    def __post_init__(self) -> None:
        check_settings(self)

    def level_scales(self, shape: tuple[int, int, int]) -> list[tuple[float, float, float]]:
        """Return the cells per unit length of each level along canonical (lateral, axial, bscan).

        Args:
            shape: voxels along (bscan, axial, lateral).
        """
        longest = max(shape)
        finest = max(self.finest_ratio * longest, self.base_resolution)
        growth = (finest / self.base_resolution) ** (1.0 / max(self.levels - 1, 1))
        ratios = [n / longest if self.follow_shape else 1.0 for n in (shape[2], shape[1], shape[0])]
        scales = []
        for level in range(self.levels):
            resolution = self.base_resolution * growth**level
            lateral, axial, bscan = (max(resolution * ratio - 1.0, 1.0) for ratio in ratios)
            scales.append((lateral, axial, bscan))
        return scales


class HashGrid(nn.Module):
    """Trainable feature tables on grids of growing resolution, interpolated trilinearly.

    Differentiable any number of times in the tables and, through the reference path, in the positions: inside a cell
    the derivative along one axis is exact and constant along that axis, so unmixed second derivatives vanish; at cell
    faces the derivative is that of the cell on the far side. Positions outside [-1, 1]^3 take the value at the nearest
    point of the cube. Works on any device; evaluation is thread-safe, training is not.

    Args:
        config: shape of the encoding.
        shape: voxels of the volume along (bscan, axial, lateral).
    """

    def __init__(self, config: HashGridConfig, shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.config = config
        capacity = 2**config.log2_table_size
        self._levels: list[_Level] = []
        rows = 0
        for scale in config.level_scales(shape):
            vertices = tuple(math.floor(s + 0.5) + 2 for s in scale)
            dense = math.prod(vertices) <= capacity
            size = math.prod(vertices) if dense else capacity
            self._levels.append(_Level(scale, vertices, dense, rows, size))
            rows += size
        self.table = nn.Parameter(torch.empty(rows, config.features).uniform_(-1e-4, 1e-4))

    @property
    def width(self) -> int:
        """Length of the feature vector."""
        return self.config.levels * self.config.features

    def forward(self, points: Tensor) -> Tensor:
        """Encode canonical points [N, (lateral, axial, bscan)] as features [N, levels * features].

        Points that require a gradient take the reference path; others a fused one with equal values and table
        gradients (tested), which is about three times faster to train on a CPU.
        """
        rows, weights = self._rows_and_weights(points)
        if points.requires_grad:
            features = interpolate_reference(self.table, rows, weights)
        else:
            features = _FusedInterpolation.apply(self.table, rows, weights)
        return features.reshape(points.shape[0], self.width)

    def forward_lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Encode the lattice of three canonical coordinate vectors as features [bscan, axial, lateral, width].

        Neighbouring lattice points share vertices and trilinear interpolation is separable, so each vertex is read
        once and blended axis by axis: equal to `forward` at the same points (tested) at a fraction of its cost. Not
        differentiable.
        """
        answer = torch.empty(
            len(bscan), len(axial), len(lateral), self.width, dtype=self.table.dtype, device=self.table.device
        )
        units = [(axis.clamp(-1.0, 1.0) + 1.0) * 0.5 for axis in (lateral, axial, bscan)]
        features = self.config.features
        for number, level in enumerate(self._levels):
            level.blend_lattice(self.table.detach(), units, answer[..., number * features : (number + 1) * features])
        return answer

    def _rows_and_weights(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return table rows [N * levels, 8] and their interpolation weights [N * levels, 8]."""
        unit = (points.clamp(-1.0, 1.0) + 1.0) * 0.5
        all_rows, all_weights = [], []
        for level in self._levels:
            rows, weights = level.corners(unit)
            all_rows.append(rows)
            all_weights.append(weights)
        rows = torch.stack(all_rows, dim=1).reshape(-1, 8)
        weights = torch.stack(all_weights, dim=1).reshape(-1, 8)
        return rows, weights


@dataclass(frozen=True)
class _Level:
    scale: tuple[float, float, float]
    vertices: tuple[int, ...]
    dense: bool
    first_row: int
    size: int

    @property
    def factors(self) -> tuple[int, int, int]:
        """What a vertex number is multiplied by along each axis before the three are combined."""
        return (1, self.vertices[0], self.vertices[0] * self.vertices[1]) if self.dense else _PRIMES

    def combine(self, first: Tensor, second: Tensor, third: Tensor) -> Tensor:
        """Return table rows of vertices from their factored numbers along the three axes."""
        row = first + second + third if self.dense else (first ^ second ^ third) & (self.size - 1)
        return row + self.first_row

    def blend_lattice(self, table: Tensor, units: list[Tensor], out: Tensor) -> None:
        """Write this level's features [bscan, axial, lateral, F] of a lattice in unit coordinates into `out`."""
        numbers, near, far, shares = [], [], [], []
        for axis, unit in enumerate(units):
            position = unit * self.scale[axis] + 0.5
            cell = position.floor()
            low = cell.long()
            used, where = torch.unique(torch.stack((low, low + 1)), return_inverse=True)
            numbers.append(used * self.factors[axis])
            near.append(where[0])
            far.append(where[1])
            shares.append(position - cell)
        rows = self.combine(numbers[0], numbers[1][:, None], numbers[2][:, None, None])
        values = table[rows]
        for axis, dim in ((0, 2), (1, 1)):
            values = _blend(values, near[axis], far[axis], shares[axis], dim)
        torch.lerp(values[near[2]], values[far[2]], shares[2][:, None, None, None], out=out)

    def corners(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows and weights [N, 8] of the vertices around points [N, 3] in unit coordinates."""
        position = unit * unit.new_tensor(self.scale) + 0.5
        cell = position.detach().floor()
        fraction = position - cell
        low = cell.long()
        factors = self.factors
        # Products along each axis for the near and the far vertex; a corner combines one of each.
        products = [(low[:, axis] * factors[axis], (low[:, axis] + 1) * factors[axis]) for axis in range(3)]
        shares = [(1.0 - fraction[:, axis], fraction[:, axis]) for axis in range(3)]
        rows, weights = [], []
        for a, b, c in _CORNERS:
            first, second, third = products[0][a], products[1][b], products[2][c]
            rows.append(self.combine(first, second, third))
            weights.append(shares[0][a] * shares[1][b] * shares[2][c])
        return torch.stack(rows, dim=-1), torch.stack(weights, dim=-1)


def _blend(values: Tensor, near: Tensor, far: Tensor, share: Tensor, dim: int) -> Tensor:
    shape = [1] * values.dim()
    shape[dim] = -1
    return torch.lerp(values.index_select(dim, near), values.index_select(dim, far), share.view(shape))


def interpolate_reference(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Gather and blend feature rows: table [R, F], rows [M, 8], weights [M, 8] -> [M, F].

    The plain reference: differentiable any number of times in the table and in the weights.
    """
    return (table[rows] * weights[..., None]).sum(dim=1)


class _FusedInterpolation(torch.autograd.Function):
    """The same sum without the [M, 8, F] intermediates; differentiable once, in the table only."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.table_rows = table.shape[0]  # type: ignore[attr-defined]
        return nn.functional.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: torch.autograd.function.FunctionCtx, grad: Tensor) -> tuple[Tensor, None, None]:
        rows, weights = ctx.saved_tensors  # type: ignore[attr-defined]
        shares = (grad[:, None, :] * weights[..., None]).reshape(-1, grad.shape[1])
        table_grad = grad.new_zeros(ctx.table_rows, grad.shape[1])  # type: ignore[attr-defined]
        table_grad.index_add_(0, rows.reshape(-1), shares)
        return table_grad, None, None
