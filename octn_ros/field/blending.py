"""Weighted sums of feature rows: the readable reference and a fused form of equal values and gradients."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def blend_reference(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Gather and blend feature rows: table [R, F], rows [M, C], weights [M, C] -> [M, F].

    The plain reference: differentiable any number of times in the table and in the weights.
    """
    return (table[rows] * weights[..., None]).sum(dim=1)


def blend(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Return the same sum without its [M, C, F] intermediates; differentiable once, in the table only."""
    return _FusedBlend.apply(table, rows, weights)


class _FusedBlend(torch.autograd.Function):
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
