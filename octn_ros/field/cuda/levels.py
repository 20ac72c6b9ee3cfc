"""A hash grid's geometry as the tensors that the Triton kernels take."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from octn_ros.field.hash_grid import HashGrid


class Levels(NamedTuple):
    """The levels of a hash grid; axes are ordered (lateral, axial, bscan), as points are.

    Attributes:
        scale: cells per unit length [levels, 3], float32.
        factor: what vertex numbers are multiplied by [levels, 3], int32; the hash's primes wrap around, which changes
            none of the bits that a table's mask keeps.
        first_row: first table row of each level [levels], int64.
        mask: hashed rows less one, -1 where a level is dense [levels], int32.
    """

    scale: Tensor
    factor: Tensor
    first_row: Tensor
    mask: Tensor

    @classmethod
    def of(cls, grid: HashGrid) -> Levels:
        """Describe a grid, on the device of its table."""
        levels, device = grid.grid_levels, grid.table.device
        return cls(
            torch.tensor([level.scale for level in levels], dtype=torch.float32, device=device),
            torch.tensor([[_wrapped(f) for f in level.factors] for level in levels], dtype=torch.int32, device=device),
            torch.tensor([level.first_row for level in levels], dtype=torch.int64, device=device),
            torch.tensor([-1 if level.dense else level.size - 1 for level in levels], dtype=torch.int32, device=device),
        )


def _wrapped(factor: int) -> int:
    return (factor + 2**31) % 2**32 - 2**31
