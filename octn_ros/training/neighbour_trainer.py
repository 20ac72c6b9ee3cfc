"""Learning from neighbours: the network predicts B-scans from the B-scans beside them, whose speckle is another."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from octn_ros.errors import TrainingError
from octn_ros.field import NeuralModel
from octn_ros.field.network import Network
from octn_ros.training.held_in import EVALUATED_BSCANS, evaluated_bscans
from octn_ros.training.point_trainer import without_graph
from octn_ros.training.scale_space import check_scales, features_between, fill_with_scales
from octn_ros.training.tissue_sheet import TissueSheet
from octn_ros.volume import Volume

# B-scans on each side that a prediction sees. They lie two apart, as if every other one had not been measured, so
# that whatever is learned is learned from speckle that the predicted B-scan does not share.
_REACH = 3
# Samples kept, of all predicted B-scans together: 50 MB at six features.
_MOST_SAMPLES = 1 << 21
_FEWEST = 6  # B-scans that are predicted, however large they are
# Of features in a direction that counts; intensities are between 0 and 1.
_LEAST_VARIANCE = 1e-6
# Intensities and their averages lie in [0, 1]; carried through a ReLU they must not fall below 0.
_LIFT = 1.0


class NeighbourTrainer:
    """Fits a model in place to what its volume's B-scans have in common with their neighbours.

    The model's tables are set to the volume at several scales (`fill_with_scales`) and stay so. The network learns
    which scales to believe where: from the same tables made of every other B-scan it predicts those left out. Speckle,
    which neighbours do not share, cannot be predicted; edges, which they share, can. No noise-free scan is needed, as
    in Lehtinen et al., "Noise2Noise" (2018). The network begins with the linear combination of features of least
    squared error and is trained by Adam on whitened features: neighbouring scales are nearly equal, and their
    differences, which carry the edges, are small.

    For any device; not thread-safe itself.

    Args:
        model: the model that is trained.
        volume: the C-scan; B-scans close enough that neighbours resemble each other.
        sheet: what its tissue follows.
        batch: samples of a step.
        seed: of the samples.
        cancelled: asked before every B-scan while the tables are made; after True no step is done.
        keep_network: go on from the model's network, which was fitted to a scan like this one.

    Raises:
        TrainingError: there are too few B-scans, or a level shares rows between vertices.
    """

    def __init__(
        self,
        model: NeuralModel,
        volume: Volume,
        sheet: TissueSheet,
        batch: int,
        seed: int,
        cancelled: Callable[[], bool],
        *,
        keep_network: bool = False,
    ) -> None:
        self._model, self._batch = model, batch
        self.trained: nn.Module = model.network
        self.samples = 0
        device = model.grid.table.device
        check_scales(model.grid)
        features, intensities = _predictions(model, volume, sheet, seed, cancelled)
        fill_with_scales(model.grid, volume.normalized, sheet, volume.geometry.shape, cancelled)
        mean, to_white, from_white = _whitening(features)
        for rows in range(0, len(features), 1 << 16):
            part = features[rows : rows + (1 << 16)]
            part[:] = (part - mean) @ to_white
        self._mean, self._to_white = torch.from_numpy(mean).to(device), torch.from_numpy(to_white).to(device)
        self._features = torch.from_numpy(features).to(device)
        self._intensities = torch.from_numpy(intensities).to(device)
        self._network = copy.deepcopy(model.network)
        if keep_network:
            first = self._network.linear_layers[0]
            with torch.no_grad():
                first.bias.add_(first.weight @ self._mean)
                first.weight.copy_(first.weight @ torch.from_numpy(from_white).to(device).T)
        else:
            _begin_linear(self._network, features, intensities, seed)
        self._optimizer = torch.optim.Adam(self._network.parameters(), betas=(0.9, 0.99))
        self._generator = torch.Generator(device=device).manual_seed(seed)

    def step(self, rate: float, alpha: float, cancelled: Callable[[], bool]) -> Tensor | None:
        """Do one step; return its mean squared error [], None if it was cancelled and nothing has changed.

        Args:
            rate: Adam's learning rate.
            alpha: not used: there are no interpolated samples, every sample is a measured voxel.
            cancelled: asked before the step.
        """
        if cancelled():
            return None
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        device = self._features.device
        chosen = torch.randint(len(self._features), (self._batch,), generator=self._generator, device=device)
        loss = nn.functional.mse_loss(self._network(self._features[chosen]), self._intensities[chosen])
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._optimizer.step()
        self.samples += self._batch
        return loss.detach()

    def evaluate(self, points: Tensor) -> Tensor:
        """Put what was learned into the model; return its intensities [N] at canonical points [N, 3], no graph."""
        with torch.no_grad():
            for mine, theirs in zip(self._model.network.parameters(), self._network.parameters(), strict=True):
                mine.copy_(theirs)
            first = self._model.network.linear_layers[0]
            first.weight.copy_(first.weight @ self._to_white.T)
            first.bias.sub_(first.weight @ self._mean)
        return without_graph(self._model)(points)


def _predictions(
    model: NeuralModel, volume: Volume, sheet: TissueSheet, seed: int, cancelled: Callable[[], bool]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return features [N, width] from the neighbours of evenly spaced B-scans, and their intensities [N]."""
    bscans, axials, laterals = volume.geometry.shape
    if bscans < 3:
        raise TrainingError(f"expected at least 3 B-scans to learn from neighbours, got {bscans}; learn from voxels")
    fewer = max(_FEWEST, min(EVALUATED_BSCANS, _MOST_SAMPLES // (axials * laterals)))
    predicted = np.unique(evaluated_bscans(volume.geometry, fewer).clip(1, bscans - 2))
    kept = min(axials * laterals, _MOST_SAMPLES // len(predicted))
    generator = np.random.default_rng(seed)
    features = np.zeros((len(predicted) * kept, model.grid.width), np.float32)
    intensities = np.zeros(len(features), np.float32)
    config = model.grid.config
    # Neighbours lie two apart: layers are to be as close to each other as in the model's own table.
    refined = 2.0 if config.cells_per_bscan else 1.0
    for place, bscan in enumerate(predicted.tolist()):
        if cancelled():
            break
        neighbours = [
            neighbour
            for neighbour in range(bscan - 2 * _REACH + 1, bscan + 2 * _REACH, 2)
            if 0 <= neighbour < bscans
        ]  # fmt: skip
        scales = config.level_scales((len(neighbours), axials, laterals))
        levels = [
            type(level).fit((across, along, refined * slow), 2**config.log2_table_size, 0, level.smooth)
            for level, (across, along, slow) in zip(model.grid.grid_levels, scales, strict=True)
        ]
        planes = volume.normalized(neighbours)
        position = (bscan - neighbours[0]) / 2.0
        among = TissueSheet(sheet.depth[neighbours])
        answer = features_between(levels, planes, among, position, sheet.as_if_between(bscan, neighbours))
        chosen = np.sort(generator.choice(axials * laterals, kept, replace=False))
        rows = slice(place * kept, (place + 1) * kept)
        features[rows] = answer[chosen]
        intensities[rows] = volume.normalized((bscan,)).ravel()[chosen]
    return features, intensities


def _begin_linear(network: Network, features: NDArray[np.float32], intensities: NDArray[np.float32], seed: int) -> None:
    """Let a network begin as the linear combination of white features of least squared error.

    The first neuron of every layer carries it; the others begin without a say in the output, those of the first layer
    with random weights for features of variance one.
    """
    count, width = features.shape
    moments, products = 1e-6 * count * np.eye(width + 1), np.zeros(width + 1)
    for rows in range(0, count, 1 << 16):
        part = features[rows : rows + (1 << 16)].astype(np.float64)
        part = np.concatenate((part, np.ones((len(part), 1))), axis=1)
        moments += part.T @ part
        products += part.T @ intensities[rows : rows + (1 << 16)]
    *weights, offset = np.linalg.solve(moments, products).tolist()
    first, *hidden, output = network.linear_layers
    bound = 1.0 / math.sqrt(width)
    drawn = np.random.default_rng(seed).uniform(-bound, bound, (len(first.bias), width + 1))
    with torch.no_grad():
        first.weight.copy_(torch.from_numpy(drawn[:, :-1]))
        first.bias.copy_(torch.from_numpy(drawn[:, -1]))
        first.weight[0] = torch.tensor(weights)
        first.bias[0] = offset + _LIFT
        for layer in hidden:
            layer.weight[0] = 0.0
            layer.weight[0, 0] = 1.0
            layer.bias[0] = 0.0
        output.weight.zero_()
        output.weight[0, 0] = 1.0
        output.bias.fill_(-_LIFT)


def _whitening(
    features: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the mean [width] of features and the matrices [width, width] to and from white ones."""
    mean = features.mean(axis=0, dtype=np.float64)
    some = features[:: max(1, len(features) // (1 << 18))] - mean
    values, axes = np.linalg.eigh(np.atleast_2d(np.cov(some.T)))
    # What features never did while it was learned, they are not asked about later: with two B-scans, say, one and the
    # mean of both, which are alike half-way between them.
    deviation = np.sqrt(values.clip(0.0, None))
    inverse = np.where(values > _LEAST_VARIANCE, 1.0 / np.maximum(deviation, 1e-12), 0.0)
    return np.float32(mean), np.float32(axes * inverse), np.float32((axes * deviation).T)
