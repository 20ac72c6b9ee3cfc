"""The small perceptron that turns encoded features into an intensity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from octn_ros.settings import check_settings, setting

# Sharpness s of softplus, log(1 + exp(s x)) / s. tiny-cuda-nn's 10 fits 3 dB worse than ReLU, 50 within 1 dB
# (docs/field.md): features begin near zero, where a softer bend is a straight line.
_SHARPNESS = 50.0


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network; the defaults are the paper's."""

    hidden_layers: int = setting(3, "number of hidden layers", low=1, high=8)
    neurons: int = setting(128, "neurons per hidden layer", low=1, high=1024)

    activation: str = setting(
        "relu",
        "activation of the hidden layers: relu as in the paper, or softplus (of sharpness 50), which is smooth",
        choices=("relu", "softplus"),
    )

    def __post_init__(self) -> None:
        check_settings(self)


class Network(nn.Module):
    """Hidden layers and a linear output; differentiable, any device, thread-safe to evaluate.

    With softplus it is smooth; with ReLU piecewise linear, its derivative at a kink being that of the flat side.

    Args:
        config: number and width of the hidden layers, and their activation.
        inputs: length of the feature vector.
    """

    def __init__(self, config: NetworkConfig, inputs: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = inputs
        for _ in range(config.hidden_layers):
            layers += [nn.Linear(width, config.neurons), _activation(config)]
            width = config.neurons
        self.hidden = nn.Sequential(*layers)
        self.output = nn.Linear(width, 1)

    @property
    def linear_layers(self) -> list[nn.Linear]:
        """The linear layers from the first hidden one to the output."""
        return [layer for layer in (*self.hidden, self.output) if isinstance(layer, nn.Linear)]

    def forward(self, features: Tensor) -> Tensor:
        """Map features [N, inputs] to intensities [N]; not clipped to [0, 1]."""
        return self.output(self.hidden(features)).squeeze(-1)

    def forward_tangent(self, features: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
        """Map features [N, inputs] and their derivatives by one variable to intensities [N] and theirs [N].

        Forward-mode differentiation written out: no graph, twice the work of `forward`.
        """
        for layer in self.hidden:
            if isinstance(layer, nn.Linear):
                features, tangents = layer(features), nn.functional.linear(tangents, layer.weight)
            elif isinstance(layer, nn.Softplus):
                sharp = layer.beta * features
                # From its threshold on torch answers with a line, and its slope is what automatic differentiation says.
                tangents = tangents * torch.where(sharp > layer.threshold, 1.0, torch.sigmoid(sharp))
                features = layer(features)
            else:
                tangents = tangents * (features > 0)
                features = layer(features)
        return self.output(features).squeeze(-1), nn.functional.linear(tangents, self.output.weight).squeeze(-1)


def _activation(config: NetworkConfig) -> nn.Module:
    return nn.Softplus(_SHARPNESS) if config.activation == "softplus" else nn.ReLU()
