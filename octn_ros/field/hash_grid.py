"""The multiresolution hash grid: positions in a cube become interpolated feature vectors.

Conventions of tiny-cuda-nn and of Müller et al., "Instant Neural Graphics Primitives" (2022): level l has
`scale = base * growth^l - 1` cells per unit length, positions are shifted by half a cell, levels with few enough
vertices are stored densely and the others are hashed with the published primes. One difference: a dense level owns
every vertex that its cells touch, so no vertex at the far faces is shared with another one by wrap-around.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from octn_ros.errors import ConfigurationError
from octn_ros.field.blending import blend, blend_reference
from octn_ros.field.grid_level import GridLevel
from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class HashGridConfig:
    """Shape of the encoding. The defaults are the paper's; what the paper leaves open says so."""

    levels: int = setting(24, "number of resolution levels", low=1, high=32)
    features: int = setting(2, "features per level", low=1, high=16)
    log2_table_size: int = setting(20, "logarithm of the largest number of vertices stored per level", low=4, high=28)
    base_resolution: int = setting(16, "cells along the longest axis at the coarsest level", low=2, high=4096)
    finest_ratio: float = setting(
        1.0, "cells of the finest level per voxel along the longest axis (open in the paper)", low=0.05, high=4.0
    )
    follow_shape: bool = setting(
        False, "whether each axis has cells in proportion to its voxels (open in the paper; else a cube)"
    )

    axial_refinement: float = setting(
        1.0,
        "cells along the axial axis for each along the others, where cells follow the voxels (open in the paper): "
        "tissue changes faster along the beam than across it",
        low=0.25,
        high=8.0,
    )
    lateral_growth: float = setting(
        0.0,
        "lateral cells of a level over those of the next coarser one, counted down from the finest, all levels being "
        "as fine as the finest along the other axes; 0 = cells grow alike along all axes, from base_resolution on "
        "(open in the paper)",
        low=0.0,
        high=16.0,
    )
    cells_per_bscan: float = setting(
        0.0,
        "cells from one B-scan to the next, the same at every level, where B-scans are few and far between; 0 = as "
        "along the other axes (open in the paper)",
        low=0.0,
        high=8.0,
    )
    interpolation: str = setting(
        "linear",
        "weights inside a cell: linear as in the paper, or tiny-cuda-nn's smoothstep, whose field has a continuous "
        "gradient and a curvature",
        choices=("linear", "smoothstep"),
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if 0.0 < self.lateral_growth <= 1.0:
            raise ConfigurationError(
                f"lateral_growth: expected 0 or more than 1, got {self.lateral_growth}; levels grow finer"
            )

    def level_scales(self, shape: tuple[int, int, int]) -> list[tuple[float, float, float]]:
        """Return the cells per unit length of each level along canonical (lateral, axial, bscan).

        Args:
            shape: voxels along (bscan, axial, lateral).
        """
        longest = max(shape)
        finest = max(self.finest_ratio * longest, self.base_resolution)
        growth = (finest / self.base_resolution) ** (1.0 / max(self.levels - 1, 1))
        ratios = [1.0, 1.0, 1.0]
        if self.follow_shape:
            ratios = [shape[2] / longest, shape[1] / longest * self.axial_refinement, shape[0] / longest]
        scales = []
        for level in range(self.levels):
            cells = [self.base_resolution * growth**level * ratio for ratio in ratios]
            if self.lateral_growth:
                cells = [self.finest_ratio * longest * ratio for ratio in ratios]
                cells[0] /= self.lateral_growth ** (self.levels - 1 - level)
            lateral, axial, bscan = (max(cells_along - 1.0, 1.0) for cells_along in cells)
            if self.cells_per_bscan:
                bscan = self.cells_per_bscan * (shape[0] - 1)
            scales.append((lateral, axial, bscan))
        return scales


class HashGrid(nn.Module):
    """Trainable feature tables on grids of growing resolution, interpolated trilinearly or by smoothstep.

    Differentiable any number of times in the tables and, through the reference path, in the positions. Derivatives
    are exact inside a cell. With linear weights the derivative along an axis is constant along that axis (unmixed
    second derivatives vanish) and jumps at cell faces, where that of the far cell is returned. With smoothstep the
    first derivative is continuous (it vanishes on the faces of its axis) and the second jumps there. Positions
    outside [-1, 1]^3 take the value at the nearest point of the cube, and no derivative along the axes they left.
    Works on any device; evaluation is thread-safe, training is not.

    Args:
        config: shape of the encoding.
        shape: voxels of the volume along (bscan, axial, lateral).
    """

    def __init__(self, config: HashGridConfig, shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.config = config
        levels: list[GridLevel] = []
        rows = 0
        for scale in config.level_scales(shape):
            level = GridLevel.fit(scale, 2**config.log2_table_size, rows, config.interpolation == "smoothstep")
            levels.append(level)
            rows += level.size
        self.grid_levels = tuple(levels)
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
        features = (blend_reference if points.requires_grad else blend)(self.table, rows, weights)
        return features.reshape(points.shape[0], self.width)

    def forward_axial_tangent(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Encode canonical points [N, 3] as features and their exact derivatives by the axial coordinate, both
        [N, width].

        The vertices of a cell's near and far axial face are blended apart: their difference is the slope. As many
        reads as `forward`, no graph.
        """
        unit = _unit(points, self.table)
        parts = [level.axial_corners(unit) for level in self.grid_levels]
        rows, weights, share, slope = (torch.stack(part, dim=1) for part in zip(*parts, strict=True))
        weights = weights[:, :, None, :].expand_as(rows)
        faces = blend(self.table.detach(), rows.view(-1, 4), weights.reshape(-1, 4)).view(
            *rows.shape[:3], self.config.features
        )
        near, far = faces[:, :, 0], faces[:, :, 1]
        # Half: a canonical coordinate runs twice as far as a unit one. Outside the cube the value is held.
        slope = 0.5 * slope * (points[:, 1].abs() <= 1.0)[:, None]
        features = torch.lerp(near, far, share[..., None])
        tangents = (far - near) * slope[..., None]
        return features.view(len(points), self.width), tangents.view(len(points), self.width)

    def forward_lines(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        """Encode the points at canonical depths [N, K] of axial lines at lateral [N], bscan [N] as [N, K, width].

        What lines have in common along their depth is done once: equal to `forward` at the same points (tested). Not
        differentiable.
        """
        answer = self.table.new_empty(*axial.shape, self.width)
        units = [_unit(axis, self.table) for axis in (lateral, bscan, axial)]
        for level, out in zip(self.grid_levels, self._parts(answer), strict=True):
            level.blend_lines(self.table.detach(), units[0], units[1], units[2], out)
        return answer

    def forward_lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Encode the lattice of three canonical coordinate vectors as features [bscan, axial, lateral, width].

        Neighbouring lattice points share vertices and the interpolation is separable, so each vertex is read once and
        blended axis by axis: equal to `forward` at the same points (tested) at a fraction of its cost. Not
        differentiable.
        """
        answer = self.table.new_empty(len(bscan), len(axial), len(lateral), self.width)
        units = [_unit(axis, self.table) for axis in (lateral, axial, bscan)]
        for level, out in zip(self.grid_levels, self._parts(answer), strict=True):
            level.blend_lattice(self.table.detach(), units, out)
        return answer

    def _parts(self, features: Tensor) -> tuple[Tensor, ...]:
        return features.split(self.config.features, dim=-1)

    def _rows_and_weights(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return table rows [N * levels, 8] and their interpolation weights [N * levels, 8]."""
        unit = _unit(points, self.table)
        parts = [level.corners(unit) for level in self.grid_levels]
        rows, weights = (torch.stack(part, dim=1).reshape(-1, 8) for part in zip(*parts, strict=True))
        return rows, weights


def _unit(canonical: Tensor, table: Tensor) -> Tensor:
    return (canonical.to(table.dtype).clamp(-1.0, 1.0) + 1.0) * 0.5
