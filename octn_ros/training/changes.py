"""Where a new scan differs from a field fitted before: there a warm refit looks first."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from octn_ros.field import NeuralModel
from octn_ros.field.field import CHUNK_POINTS
from octn_ros.training.sampling import ResidentVoxels

BLOCK = 8  # voxels along each axis
SAMPLES = 8  # voxels of a block that tell whether it has changed
# A block counts as changed if its error is this many times that of the median block. With 8 samples of an unchanged
# one, which holds speckle alone, that is more than five standard deviations.
CHANGED = 4.0


class ChangedBlocks:
    """The blocks of a scan that a field no longer describes, drawn from in proportion to how wrong it is there.

    Args:
        voxels: the new scan.
        model: the field's model, fitted to an earlier scan of the same geometry.
    """

    def __init__(self, voxels: ResidentVoxels, model: NeuralModel) -> None:
        self._shape = voxels.geometry.shape
        self._grid = tuple(math.ceil(n / BLOCK) for n in self._shape)
        generator = torch.Generator(device=voxels.device).manual_seed(0)
        errors = []
        with torch.no_grad():
            for blocks in torch.arange(math.prod(self._grid), device=voxels.device).split(CHUNK_POINTS // SAMPLES):
                flat = self._within(blocks.repeat_interleave(SAMPLES), generator)
                squared = (model(voxels.points(flat)) - voxels.at(flat)).square()
                errors.append(squared.view(-1, SAMPLES).mean(dim=1))
        error = torch.cat(errors)
        self._weights = torch.where(error > CHANGED * error.median(), error, torch.zeros_like(error))
        self.share = float((self._weights > 0).float().mean())
        """Share of the blocks that have changed."""

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the flat numbers [count] of voxels in changed blocks; there must be some (`share` above 0)."""
        return self._within(torch.multinomial(self._weights, count, replacement=True, generator=generator), generator)

    def _within(self, blocks: Tensor, generator: torch.Generator) -> Tensor:
        """Draw one voxel, as a flat number, in each of the blocks [N]."""
        _, rows, columns = self._grid
        corner = torch.stack((blocks // (rows * columns), blocks // columns % rows, blocks % columns), dim=-1) * BLOCK
        size = (corner.new_tensor(self._shape) - corner).clamp_(max=BLOCK)  # blocks at the far faces are cut off
        unit = torch.rand(size.shape, generator=generator, device=blocks.device)
        bscan, axial, lateral = (corner + (unit * size).long()).unbind(-1)
        return (bscan * self._shape[1] + axial) * self._shape[2] + lateral
