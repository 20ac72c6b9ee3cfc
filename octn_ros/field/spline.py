"""Interpolation through voxels by separable bases: linear, and cubic B-splines with exact derivatives."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

InterpolationOrder = Literal["trilinear", "cubic"]


class Spline:
    """A volume of coefficients and the basis that turns them into values; immutable, thread-safe.

    The cubic B-spline passes through the voxels and is twice continuously differentiable everywhere inside the array.
    Its coefficients come from `scipy.ndimage.spline_filter` with mode "mirror" (the volume is continued by reflection
    about the centres of its outer voxels, without repeating them), so that voxel values are reproduced up to float32
    rounding and the first derivative across an outer face is zero on that face.

    Args:
        voxels: intensities [bscan, axial, lateral], at least 2 along each axis.
        order: "trilinear" or "cubic".
        device: where the coefficients are kept.
    """

    def __init__(self, voxels: NDArray[np.float32], order: InterpolationOrder, device: str | torch.device) -> None:
        self.shape = voxels.shape
        if order == "cubic":
            coefficients = ndimage.spline_filter(voxels, order=3, output=np.float32, mode="mirror")
            voxels = np.pad(coefficients, 1, mode="reflect")
        self._taps = 4 if order == "cubic" else 2
        self.coefficients = torch.from_numpy(voxels).to(device)

    def cell(self, index: Tensor, axis: int) -> tuple[Tensor, Tensor]:
        """Split fractional indices along an array axis into the first coefficient of their cell and the fraction."""
        cell = index.detach().floor().long().clamp(0, self.shape[axis] - 2)
        return cell, index - cell

    def weights(self, fraction: Tensor, derivative: int = 0) -> list[Tensor]:
        """Return the weight of each coefficient of a cell, or its derivative by the index; differentiable.

        Args:
            fraction: place in the cell, 0 to 1, any shape.
            derivative: 0, 1 or 2.
        """
        t = fraction
        if self._taps == 2:
            one, zero = torch.ones_like(t), torch.zeros_like(t)
            return [[1.0 - t, t], [-one, one], [zero, zero]][derivative]
        s = 1.0 - t
        if derivative == 0:
            return [s**3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (3 * s**3 - 6 * s**2 + 4) / 6, t**3 / 6]
        if derivative == 1:
            return [-(s**2) / 2, (3 * t**2 - 4 * t) / 2, (4 * s - 3 * s**2) / 2, t**2 / 2]
        return [s, 3 * t - 2, 3 * s - 2, t]

    def value(self, index: Tensor) -> Tensor:
        """Return the values [N] at fractional indices [N, (bscan, axial, lateral)]; differentiable in them."""
        cells, fractions = zip(*(self.cell(index[:, axis], axis) for axis in range(3)), strict=True)
        planes = self.weights(fractions[0])
        rows = self.weights(fractions[1])
        columns = torch.stack(self.weights(fractions[2]), dim=-1)
        total = torch.zeros_like(fractions[0])
        for d, plane in enumerate(planes):
            for h, row in enumerate(rows):
                run = self._runs(cells[0] + d, cells[1] + h, cells[2])
                total = total + plane * row * (run * columns).sum(dim=-1)
        return total

    def derivatives(self, index: Tensor, highest: int) -> Tensor:
        """Return all derivatives up to the `highest` (1 or 2) along each axis at fractional indices [N, 3].

        Returns:
            [highest + 1, highest + 1, highest + 1, N]: entry [i, j, k] is the i-th derivative by the bscan, j-th by
            the axial and k-th by the lateral index.
        """
        cells, fractions = zip(*(self.cell(index[:, axis], axis) for axis in range(3)), strict=True)
        orders = range(highest + 1)
        planes, rows, columns = (
            torch.stack([torch.stack(self.weights(fraction, order)) for order in orders]) for fraction in fractions
        )
        answer = index.new_zeros(len(orders), len(orders), len(orders), len(index))
        for d in range(self._taps):
            image = torch.zeros_like(answer[0])
            for h in range(self._taps):
                run = self._runs(cells[0] + d, cells[1] + h, cells[2]).T
                image += rows[:, h][:, None] * (columns * run).sum(dim=1)
            answer += planes[:, d][:, None, None] * image
        return answer

    def axial_value_and_slope(self, bscan: Tensor, axial: Tensor, lateral: Tensor) -> tuple[Tensor, Tensor]:
        """Return values [N] and derivatives by the axial index [N] at fractional indices [N] each."""
        plane_cell, plane_fraction = self.cell(bscan, 0)
        row_cell, row_fraction = self.cell(axial, 1)
        column_cell, column_fraction = self.cell(lateral, 2)
        planes = self.weights(plane_fraction)
        columns = torch.stack(self.weights(column_fraction), dim=-1)
        across = []
        for h in range(self._taps):
            runs = [
                plane[:, None] * self._runs(plane_cell + d, row_cell + h, column_cell) for d, plane in enumerate(planes)
            ]
            across.append((torch.stack(runs).sum(dim=0) * columns).sum(dim=-1))
        values = torch.stack(across)
        return tuple((values * torch.stack(self.weights(row_fraction, order))).sum(dim=0) for order in (0, 1))  # type: ignore[return-value]

    def lines(self, bscan: Tensor, axial: Tensor, lateral: Tensor) -> Tensor:
        """Return the values [N, K] at axial indices [N, K] of the lines at bscan [N] and lateral [N] indices.

        Coefficients along a line are blended across once, then along it.
        """
        plane_cell, plane_fraction = self.cell(bscan, 0)
        column_cell, column_fraction = self.cell(lateral, 2)
        row_cell, row_fraction = self.cell(axial, 1)
        start = row_cell.amin(dim=1)
        count = int((row_cell.amax(dim=1) - start).max()) + self._taps
        if count > self._taps * axial.shape[1]:
            # Depths so far apart that no two share a coefficient.
            index = torch.stack((bscan[:, None].expand_as(axial), axial, lateral[:, None].expand_as(axial)), dim=-1)
            return self.value(index.view(-1, 3)).view(axial.shape)
        rows = start[:, None] + torch.arange(count, device=axial.device)
        columns = torch.stack(self.weights(column_fraction), dim=-1)
        across = torch.zeros_like(rows, dtype=axial.dtype)
        for d, plane in enumerate(self.weights(plane_fraction)):
            runs = self._runs(
                (plane_cell + d)[:, None], rows.clamp(max=self.coefficients.shape[1] - 1), column_cell[:, None]
            )
            across += (runs * (plane[:, None] * columns)[:, None, :]).sum(dim=-1)
        first = row_cell - start[:, None]
        taps = [across.gather(1, first + h) * weight for h, weight in enumerate(self.weights(row_fraction))]
        return torch.stack(taps).sum(dim=0)

    def lattice(self, bscan: Tensor, axial: Tensor, lateral: Tensor) -> Tensor:
        """Return the values [bscan, axial, lateral] on the lattice of three vectors of fractional indices.

        Each coefficient is read once and blended axis by axis.
        """
        firsts, weights, used = [], [], []
        for axis, index in enumerate((bscan, axial, lateral)):
            cell, fraction = self.cell(index, axis)
            taps = torch.stack([cell + tap for tap in range(self._taps)])
            own, where = torch.unique(taps, return_inverse=True)
            used.append(own)
            firsts.append(where)
            weights.append(self.weights(fraction))
        values = self.coefficients[used[0]][:, used[1]][:, :, used[2]]
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = -1
            parts = [
                values.index_select(axis, where) * weight.view(shape)
                for where, weight in zip(firsts[axis], weights[axis], strict=True)
            ]
            values = torch.stack(parts).sum(dim=0)
        return values

    def _runs(self, plane: Tensor, row: Tensor, column: Tensor) -> Tensor:
        """Return the coefficients [..., taps] that lie side by side along the lateral axis from a first one on."""
        strides = self.coefficients.stride()
        first = plane * strides[0] + row * strides[1] + column
        windows = self.coefficients.as_strided((self.coefficients.numel() - self._taps + 1, self._taps), (1, 1))
        return windows[first]
