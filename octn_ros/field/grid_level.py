"""One resolution level of the hash grid: where a point's vertices are stored, and how they are weighted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from octn_ros.field.blending import blend

# tiny-cuda-nn's "coherent prime hash" and its corner order, the first axis running fastest.
PRIMES = (1, 2654435761, 805459861)
_CORNERS = tuple((a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1))


@dataclass(frozen=True)
class GridLevel:
    """Geometry of a level in unit coordinates [0, 1]^3 (lateral, axial, bscan); holds no features itself.

    Attributes:
        scale: cells per unit length along (lateral, axial, bscan).
        dense: whether every vertex has a row of its own; otherwise rows are shared by the spatial hash.
        first_row: where this level begins in the table of all levels.
        size: rows of this level.
        smooth: whether weights are smoothstep's 3 t^2 - 2 t^3 instead of t.
    """

    scale: tuple[float, float, float]
    dense: bool
    first_row: int
    size: int
    smooth: bool

    @classmethod
    def fit(cls, scale: tuple[float, float, float], capacity: int, first_row: int, smooth: bool) -> GridLevel:
        """Return the level of that scale, dense if its vertices are at most `capacity`."""
        vertices = math.prod(vertices_along(scale))
        dense = vertices <= capacity
        return cls(scale, dense, first_row, vertices if dense else capacity, smooth)

    @cached_property
    def vertices(self) -> tuple[int, int, int]:
        """Vertices that its cells touch along (lateral, axial, bscan)."""
        return vertices_along(self.scale)

    @cached_property
    def factors(self) -> tuple[int, int, int]:
        """What a vertex number is multiplied by along each axis before the three are combined."""
        return (1, self.vertices[0], self.vertices[0] * self.vertices[1]) if self.dense else PRIMES

    def combine(self, first: Tensor, second: Tensor, third: Tensor) -> Tensor:
        """Return table rows of vertices from their factored numbers along the three axes."""
        row = first + second + third if self.dense else (first ^ second ^ third) & (self.size - 1)
        return row + self.first_row

    def share(self, fraction: Tensor) -> Tensor:
        """Return the weight of the far vertex at a fraction [0, 1) of the cell."""
        return fraction * fraction * (3.0 - 2.0 * fraction) if self.smooth else fraction

    def share_slope(self, fraction: Tensor) -> Tensor:
        """Return the derivative of `share` by the fraction."""
        return 6.0 * fraction * (1.0 - fraction) if self.smooth else torch.ones_like(fraction)

    def corners(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows and weights [N, 8] of the vertices around points [N, 3]; differentiable in the weights."""
        products, shares = [], []
        for axis in range(3):
            near, far, fraction = self._cell(unit[:, axis], axis)
            share = self.share(fraction)
            products.append((near, far))
            shares.append((1.0 - share, share))
        rows, weights = [], []
        for a, b, c in _CORNERS:
            rows.append(self.combine(products[0][a], products[1][b], products[2][c]))
            weights.append(shares[0][a] * shares[1][b] * shares[2][c])
        return torch.stack(rows, dim=-1), torch.stack(weights, dim=-1)

    def axial_corners(self, unit: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what interpolates points [N, 3] across first and along the axial axis last.

        Returns:
            rows [N, 2, 4] of the vertices in the near and the far axial face of the cell, their weights [N, 4], the
            far face's share [N] and its derivative by the unit axial coordinate [N].
        """
        column_rows, weights = self._columns(unit[:, 0], unit[:, 2])
        near, far, fraction = self._cell(unit[:, 1], 1)
        rows = torch.stack([self._join(column_rows, axial[:, None]) for axial in (near, far)], dim=1)
        return rows, weights, self.share(fraction), self.share_slope(fraction) * self.scale[1]

    def blend_lines(self, table: Tensor, lateral: Tensor, bscan: Tensor, axial: Tensor, out: Tensor) -> None:
        """Write the features [N, K, F] at unit depths [N, K] of the axial lines at lateral [N], bscan [N] to `out`.

        The vertices that a line passes are blended across once and then along it, whatever the number of depths.
        """
        column_rows, weights = self._columns(lateral, bscan)
        low, fraction = self._place(axial, 1)
        start = low.amin(dim=1)
        count = int((low.amax(dim=1) - start).max()) + 2
        if count > 2 * axial.shape[1]:
            # Depths so far apart that hardly two share a vertex: 8 rows a depth are fewer than 4 a vertex.
            x, z = (across[:, None].expand_as(axial).reshape(-1) for across in (lateral, bscan))
            point_rows, point_weights = self.corners(torch.stack((x, axial.reshape(-1), z), dim=-1))
            out.copy_(blend(table, point_rows, point_weights).view(out.shape))
            return
        passed = start[:, None] + torch.arange(count, device=axial.device)
        # The line that passes most vertices sets the count; others must not run out of the grid.
        numbers = passed.clamp(max=self.vertices[1] - 1) * self.factors[1]
        rows = self._join(column_rows[:, None, :], numbers[:, :, None])
        shares = weights[:, None, :].expand_as(rows)
        values = blend(table, rows.reshape(-1, 4), shares.reshape(-1, 4)).view(len(lateral), count, -1)
        where = (low - start[:, None])[..., None].expand(-1, -1, values.shape[-1])
        torch.lerp(values.gather(1, where), values.gather(1, where + 1), self.share(fraction)[..., None], out=out)

    def blend_lattice(self, table: Tensor, units: list[Tensor], out: Tensor) -> None:
        """Write this level's features [bscan, axial, lateral, F] of a lattice in unit coordinates into `out`."""
        numbers, near, far, shares = [], [], [], []
        for axis, unit in enumerate(units):
            low, fraction = self._place(unit, axis)
            used, where = torch.unique(torch.stack((low, low + 1)), return_inverse=True)
            numbers.append(used * self.factors[axis])
            near.append(where[0])
            far.append(where[1])
            shares.append(self.share(fraction))
        rows = self.combine(numbers[0], numbers[1][:, None], numbers[2][:, None, None])
        values = table[rows]
        for axis, dim in ((0, 2), (1, 1)):
            values = _lerp(values, near[axis], far[axis], shares[axis], dim)
        torch.lerp(values[near[2]], values[far[2]], shares[2][:, None, None, None], out=out)

    def _cell(self, unit: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the factored numbers of the near and the far vertex along an axis, and the fraction between them."""
        low, fraction = self._place(unit, axis)
        factor = self.factors[axis]
        near = low * factor
        return near, near + factor, fraction

    def _place(self, unit: Tensor, axis: int) -> tuple[Tensor, Tensor]:
        """Return the number of the cell along an axis and the fraction within it."""
        position = unit * self.scale[axis] + 0.5
        cell = position.detach().floor()
        return cell.long(), position - cell

    def _columns(self, lateral: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return the factored numbers [N, 4] of the vertex columns around axial lines, axial left out, and weights."""
        near_x, far_x, fraction_x = self._cell(lateral, 0)
        near_z, far_z, fraction_z = self._cell(bscan, 2)
        share_x, share_z = self.share(fraction_x), self.share(fraction_z)
        join = torch.add if self.dense else torch.bitwise_xor
        rows = [join(x, z) for z in (near_z, far_z) for x in (near_x, far_x)]
        weights = [x * z for z in (1.0 - share_z, share_z) for x in (1.0 - share_x, share_x)]
        return torch.stack(rows, dim=-1), torch.stack(weights, dim=-1)

    def _join(self, column_rows: Tensor, axial: Tensor) -> Tensor:
        return self.combine(column_rows, axial, torch.zeros((), dtype=axial.dtype, device=axial.device))


def vertices_along(scale: tuple[float, float, float]) -> tuple[int, int, int]:
    """Return the vertices that the cells of a level touch along each axis, half-cell offset included.

    Counted in float32, in which positions are computed: where the far face rounds up to the next cell, as it does for
    half the odd numbers of voxels at half a cell per voxel, that cell's vertices are there.
    """
    half = np.float32(0.5)
    lateral, axial, bscan = (math.floor(np.float32(s) + half) + 2 for s in scale)
    return lateral, axial, bscan


def _lerp(values: Tensor, near: Tensor, far: Tensor, share: Tensor, dim: int) -> Tensor:
    shape = [1] * values.dim()
    shape[dim] = -1
    return torch.lerp(values.index_select(dim, near), values.index_select(dim, far), share.view(shape))
