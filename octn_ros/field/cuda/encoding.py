"""The hash grid run by Triton kernels, as a function that torch can differentiate."""

from __future__ import annotations

from typing import Any

import torch
import triton
from torch import Tensor

from octn_ros.field.cuda.encode_kernels import encode_kernel, point_gradient_kernel, table_gradient_kernel
from octn_ros.field.cuda.levels import Levels
from octn_ros.field.hash_grid import HashGrid

# Points of a program, and how its kernel is compiled: with additions and multiplications apart, as the reference does
# them, so that a point on a cell face falls into the same cell.
_BLOCK = 128
LAUNCH: dict[str, Any] = {"num_warps": 4, "enable_fp_fusion": False}


class TritonEncoding:
    """Encodes canonical points [N, 3] as features [N, levels * features], as the grid itself does.

    Differentiable once, in the table and in the points; the reference is, any number of times. On a GPU the gradient
    by the table is summed in an order left to chance, so it repeats up to rounding only. Float32; CUDA, or the CPU
    under Triton's interpreter; thread-safe.

    Args:
        grid: the hash grid; its table is shared.

    Attributes:
        grid: the same.
        constants: what its kernels are compiled for.
    """

    def __init__(self, grid: HashGrid) -> None:
        self.grid = grid
        self._levels = Levels.of(grid)
        width = grid.config.features
        self.constants = {
            "width": width,
            "tile_width": triton.next_power_of_2(width),
            "smooth": grid.config.interpolation == "smoothstep",
            "block": _BLOCK,
        }

    def __call__(self, points: Tensor) -> Tensor:
        """Encode canonical points [N, 3] on the table's device."""
        features: Tensor = _Encode.apply(points.to(torch.float32).contiguous(), self.grid.table, self)
        return features

    def features(self, points: Tensor) -> Tensor:
        """Return the features [N, width] of contiguous points [N, 3], without a graph."""
        # Features first, so that neighbouring threads write neighbouring numbers.
        answer = points.new_empty(self.grid.width, len(points))
        if len(points):
            with torch.cuda.device_of(points):
                encode_kernel[self._programs(points, by_level=True)](
                    points, self.grid.table, *self._levels, answer, len(points), **self.constants, **LAUNCH
                )
        return answer.t()

    def table_gradient(self, points: Tensor, by_features: Tensor) -> Tensor:
        """Return the gradient by the table [rows, features] from that by the features of points [N, 3]."""
        answer = torch.zeros_like(self.grid.table)
        if len(points):
            with torch.cuda.device_of(points):
                table_gradient_kernel[self._programs(points, by_level=True)](
                    points, by_features, *self._levels, answer, len(points), *by_features.stride(),
                    **self.constants, **LAUNCH,
                )  # fmt: skip
        return answer

    def point_gradient(self, points: Tensor, by_features: Tensor) -> Tensor:
        """Return the gradient by points [N, 3] from that by their features."""
        answer = torch.empty_like(points)
        if len(points):
            with torch.cuda.device_of(points):
                point_gradient_kernel[self._programs(points, by_level=False)](
                    points, self.grid.table, by_features, *self._levels, answer, len(points), *by_features.stride(),
                    len(self.grid.grid_levels), **self.constants, **LAUNCH,
                )  # fmt: skip
        return answer

    def _programs(self, points: Tensor, *, by_level: bool) -> tuple[int, int]:
        return triton.cdiv(len(points), _BLOCK), len(self.grid.grid_levels) if by_level else 1


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: torch.autograd.function.FunctionCtx, points: Tensor, table: Tensor, encoding: TritonEncoding
    ) -> Tensor:
        ctx.save_for_backward(points)
        ctx.encoding = encoding  # type: ignore[attr-defined]
        return encoding.features(points)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: torch.autograd.function.FunctionCtx, by_features: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None]:
        (points,) = ctx.saved_tensors  # type: ignore[attr-defined]
        encoding: TritonEncoding = ctx.encoding  # type: ignore[attr-defined]
        by_points, by_table, _ = ctx.needs_input_grad  # type: ignore[attr-defined]
        return (
            encoding.point_gradient(points, by_features) if by_points else None,
            encoding.table_gradient(points, by_features) if by_table else None,
            None,
        )
