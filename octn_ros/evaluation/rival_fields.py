"""Other neural fields, as their authors published them, in plain torch: what ours are held against."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn


class CuNerfNetwork(nn.Module):
    """The network of CuNeRF (Chen et al. 2023) from a position to an intensity; differentiable, any device.

    Sines and cosines of ten octaves of each coordinate, without the coordinate itself, then eight stages of 256 ReLU
    units, the fifth of which puts the encoding beside the features and does nothing else, as in the authors' code. Of
    CuNeRF's second output, a density, and of its cubes of 64 + 64 samples per voxel nothing is here: an OCT voxel is
    asked for directly, which makes a step 128 times cheaper.
    """

    def __init__(self, octaves: int = 10, width: int = 256) -> None:
        super().__init__()
        self.register_buffer("frequencies", 2.0 ** torch.arange(octaves))
        encoded = 3 * 2 * octaves
        self.before = _perceptron(encoded, width, 4)
        self.after = _perceptron(width + encoded, width, 3)
        self.last = nn.Linear(width, 1)

    def forward(self, points: Tensor) -> Tensor:
        """Map canonical points [N, 3] to intensities [N]."""
        assert isinstance(self.frequencies, Tensor)
        angles = (points[:, None, :] * self.frequencies[:, None]).flatten(1)
        encoded = torch.cat([angles.sin(), angles.cos()], dim=1)
        answer: Tensor = self.last(self.after(torch.cat([encoded, self.before(encoded)], dim=1)))
        return answer[:, 0]


class Siren(nn.Module):
    """SIREN (Sitzmann et al. 2020): layers of sines and its initialisation; differentiable, any device.

    Three hidden layers of 256 units behind the first one, omega 30 in all of them. It is fitted in [-1, 1], as by its
    authors; here the last layer's answer is taken from there to [0, 1].
    """

    OMEGA = 30.0

    def __init__(self, width: int = 256, hidden_layers: int = 3) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            [nn.Linear(3, width), *(nn.Linear(width, width) for _ in range(hidden_layers)), nn.Linear(width, 1)]
        )
        with torch.no_grad():
            for number, layer in enumerate(self.layers):
                assert isinstance(layer, nn.Linear)
                inputs = layer.in_features
                limit = 1.0 / inputs if number == 0 else math.sqrt(6.0 / inputs) / self.OMEGA
                layer.weight.uniform_(-limit, limit)

    def forward(self, points: Tensor) -> Tensor:
        """Map canonical points [N, 3] to intensities [N]."""
        features = points
        *hidden, last = self.layers
        for layer in hidden:
            features = torch.sin(self.OMEGA * layer(features))
        answer: Tensor = last(features)
        return 0.5 + 0.5 * answer[:, 0]


@dataclass(frozen=True)
class Rival:
    """A neural field and how its authors fit it.

    Attributes:
        make: gives a new one.
        learning_rate: Adam's at the start.
        final_rate_ratio: learning rate at the end over that at the start, falling exponentially.
        batch: samples per step.
        source: where these stand.
    """

    make: Callable[[], nn.Module]
    learning_rate: float
    final_rate_ratio: float
    batch: int
    source: str


RIVALS = {
    "cunerf": Rival(CuNerfNetwork, 2e-3, 1e-2, 1024, "configs/example.yaml of github.com/NarcissusEx/CuNeRF"),
    "siren": Rival(
        Siren, 1e-4, 1.0, 1024, "Sitzmann et al. 2020; the batch is CuNeRF's, since its authors take whole images"
    ),
}


def _perceptron(inputs: int, width: int, layers: int) -> nn.Sequential:
    sizes = [inputs, *[width] * layers]
    parts = [part for one, two in itertools.pairwise(sizes) for part in (nn.Linear(one, two), nn.ReLU())]
    return nn.Sequential(*parts)
