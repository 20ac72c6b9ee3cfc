"""The paper's field: hash-grid encoding and a perceptron, f_theta(x, y, z) = I (eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as dataclass_field

import torch
from torch import Tensor, nn

from octn_ros.field.field import CHUNK_POINTS, DifferentiableField, FieldDescription
from octn_ros.field.hash_grid import HashGrid, HashGridConfig
from octn_ros.field.network import Network, NetworkConfig
from octn_ros.volume import VolumeGeometry


@dataclass(frozen=True)
class NeuralFieldConfig:
    """Shape of the whole representation; the defaults are the paper's."""

    grid: HashGridConfig = dataclass_field(default_factory=HashGridConfig)
    network: NetworkConfig = dataclass_field(default_factory=NetworkConfig)


class NeuralModel(nn.Module):
    """The trainable part: encoding and network.

    Args:
        config: shape of both.
        shape: voxels of the volume along (bscan, axial, lateral), which set the finest grid level.
    """

    def __init__(self, config: NeuralFieldConfig, shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.grid = HashGrid(config.grid, shape)
        self.network = Network(config.network, self.grid.width)

    def forward(self, points: Tensor) -> Tensor:
        """Map canonical points [N, 3] to intensities [N]."""
        return self.network(self.grid(points))


class NeuralField(DifferentiableField):
    """A fitted neural field; read-only, thread-safe, on the device of its model.

    The field is piecewise smooth: with a trilinear grid and ReLU its gradient is exact inside cells and jumps at
    their faces, and it has no useful second derivatives. Values are not clipped to [0, 1].

    Args:
        model: the fitted model; frozen here.
        config: the shape it was made with.
        description: where it comes from.
    """

    def __init__(self, model: NeuralModel, config: NeuralFieldConfig, description: FieldDescription) -> None:
        self.model = model.eval().requires_grad_(False)
        self.config = config
        self._description = description

    @property
    def kind(self) -> str:
        """Always "neural"."""
        return self._description.kind

    @property
    def geometry(self) -> VolumeGeometry:
        """Shape and place of the scan."""
        return self._description.geometry

    @property
    def description(self) -> FieldDescription:
        """Origin of the field."""
        return self._description

    @property
    def device(self) -> torch.device:
        """Where the parameters lie."""
        return self.model.grid.table.device

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the intensities [N] at canonical points [N, 3]; differentiable in the points."""
        return self.model(points)

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors.

        In slabs of B-scans and axial rows that share the encoding's work; equal to `evaluate` at the same points.
        """
        answer = torch.empty(len(bscan), len(axial), len(lateral), device=self.device)
        rows = max(1, CHUNK_POINTS // max(len(lateral), 1))
        slices = max(1, rows // max(len(axial), 1))
        with torch.no_grad():
            for first in range(0, len(bscan), slices):
                for row in range(0, len(axial), rows):
                    slab = (slice(first, first + slices), slice(row, row + rows))
                    features = self.model.grid.forward_lattice(lateral, axial[slab[1]], bscan[slab[0]])
                    values = self.model.network(features.view(-1, features.shape[-1]))
                    answer[slab] = values.view(features.shape[:-1])
        return answer
