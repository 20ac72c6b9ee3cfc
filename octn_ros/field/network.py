"""The small perceptron that turns encoded features into an intensity."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network; the defaults are the paper's."""

    hidden_layers: int = setting(3, "number of hidden layers", low=1, high=8)
    neurons: int = setting(128, "neurons per hidden layer", low=1, high=1024)

    def __post_init__(self) -> None:
        check_settings(self)


class Network(nn.Module):
    """ReLU layers and a linear output; differentiable, any device, thread-safe to evaluate.

    Args:
        config: number and width of the hidden layers.
        inputs: length of the feature vector.
    """

    def __init__(self, config: NetworkConfig, inputs: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = inputs
        for _ in range(config.hidden_layers):
            layers += [nn.Linear(width, config.neurons), nn.ReLU()]
            width = config.neurons
        self.hidden = nn.Sequential(*layers)
        self.output = nn.Linear(width, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Map features [N, inputs] to intensities [N]; not clipped to [0, 1]."""
        return self.output(self.hidden(features)).squeeze(-1)
