"""The paper's field: hash-grid encoding and a perceptron, f_theta(x, y, z) = I (eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from octn_ros.field.backend import choose_backend, make_evaluator
from octn_ros.field.capacity import grid_for_volume
from octn_ros.field.field import CHUNK_POINTS, DifferentiableField, FieldDescription
from octn_ros.field.hash_grid import HashGrid, HashGridConfig
from octn_ros.field.network import Network, NetworkConfig
from octn_ros.settings import check_settings, setting
from octn_ros.volume import VolumeGeometry

if TYPE_CHECKING:
    from octn_ros.field.backend import Evaluator


@dataclass(frozen=True)
class NeuralFieldConfig:
    """Shape of the whole representation; the defaults are the paper's."""

    grid: HashGridConfig = dataclass_field(default_factory=HashGridConfig)
    network: NetworkConfig = dataclass_field(default_factory=NetworkConfig)
    bits_per_voxel: float = setting(
        0.0,
        "bits of the grid's tables, as float32, per voxel of the volume; levels, cells and table size then follow from "
        "it; 0 = as configured",
        low=0.0,
        high=64.0,
    )

    def __post_init__(self) -> None:
        check_settings(self)

    def for_volume(self, geometry: VolumeGeometry) -> NeuralFieldConfig:
        """Return the configuration with levels and table size resolved for a volume of that shape.

        With `bits_per_voxel` of 0 it is this one; the answer's own is 0, so resolving it again changes nothing.
        """
        if self.bits_per_voxel == 0:
            return self
        grid = grid_for_volume(self.grid, geometry.shape, self.bits_per_voxel)
        return replace(self, grid=grid, bits_per_voxel=0.0)


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

    The field is continuous. With linear weights and ReLU it is piecewise smooth: its gradient is exact inside cells
    and jumps at their faces, and it has no curvature of its own (unmixed second derivatives vanish almost everywhere,
    mixed ones do not). With smoothstep weights and softplus the gradient is continuous and second derivatives are
    exact inside cells. Values are not clipped to [0, 1].

    On the CPU compiled kernels answer where they can, on CUDA Triton's, equal to plain torch up to rounding; `backend`
    tells which. Further derivatives are always plain torch's.

    Args:
        model: the fitted model; frozen here.
        config: the shape it was made with.
        description: where it comes from.
        backend: "auto" for the fastest that can run the model, "torch" for the plain reference, or one of
            `octn_ros.field.backend.BACKENDS`.

    Warns:
        BackendWarning: the back end asked for cannot run the model; plain torch does.
    """

    def __init__(
        self,
        model: NeuralModel,
        config: NeuralFieldConfig,
        description: FieldDescription,
        backend: str = "auto",
    ) -> None:
        super().__init__(description)
        self.model = model.eval().requires_grad_(False)
        self.config = config
        self.backend = choose_backend(model, backend)
        # So that intermediates of the encoding (rows and weights of 8 vertices a level) stay within some 100 MB.
        self._chunk = max(1, 8 * CHUNK_POINTS // config.grid.levels)

    @property
    def device(self) -> torch.device:
        """Where the parameters lie."""
        return self.model.grid.table.device

    @cached_property
    def _evaluator(self) -> Evaluator | None:
        return make_evaluator(self.model, self.backend)

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the intensities [N] at canonical points [N, 3]; differentiable in the points."""
        if self._evaluator is not None and not points.requires_grad:
            return self._evaluator.evaluate(points)
        if points.requires_grad or len(points) <= self._chunk:
            return self.model(points)
        return torch.cat([self.model(chunk) for chunk in points.split(self._chunk)])

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and their exact gradients [N, 3] by canonical position; the graph is not kept."""
        if self._evaluator is not None:
            return self._evaluator.value_and_gradient(points)
        return super().value_and_gradient(points)

    def lattice(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        """Return intensities [bscan, axial, lateral] on the lattice of three canonical coordinate vectors.

        Neighbouring points share vertices, so this is the fast way to ask for many; equal to `evaluate` at the same
        points, in memory that does not grow with the lattice beyond the answer itself.
        """
        if self._evaluator is not None:
            return self._evaluator.lattice(lateral, axial, bscan)
        return super().lattice(lateral, axial, bscan)

    def axial_value_and_slope(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> tuple[Tensor, Tensor]:
        """Return intensities [N] and exact derivatives by the axial coordinate [N] at canonical coordinates [N].

        The axial tangent is carried through encoding and network in one forward pass: equal to automatic
        differentiation (tested), several times cheaper.
        """
        if self._evaluator is not None:
            return self._evaluator.axial_value_and_slope(lateral, axial, bscan)
        values, slopes = [lateral.new_zeros(0)], [lateral.new_zeros(0)]
        with torch.no_grad():
            for chunk in torch.stack((lateral, axial, bscan), dim=-1).split(self._chunk):
                value, slope = self.model.network.forward_tangent(*self.model.grid.forward_axial_tangent(chunk))
                values.append(value)
                slopes.append(slope)
        return torch.cat(values), torch.cat(slopes)

    def axial_lines(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        """Return intensities [N, K] at canonical depths [N, K] along the axial lines at lateral [N], bscan [N].

        The vertices that a line passes are blended across once: equal to `evaluate` at the same points, cheaper.
        """
        if self._evaluator is not None:
            return self._evaluator.axial_lines(lateral, bscan, axial)
        return super().axial_lines(lateral, bscan, axial)

    def _line_values(self, lateral: Tensor, bscan: Tensor, axial: Tensor) -> Tensor:
        return self._through_network(self.model.grid.forward_lines(lateral, bscan, axial))

    def _lattice_values(self, lateral: Tensor, axial: Tensor, bscan: Tensor) -> Tensor:
        return self._through_network(self.model.grid.forward_lattice(lateral, axial, bscan))

    def _through_network(self, features: Tensor) -> Tensor:
        return self.model.network(features.view(-1, features.shape[-1])).view(features.shape[:-1])
