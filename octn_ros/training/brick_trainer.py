"""Steps of Algorithm 1 on bricks of neighbouring samples, compiled for the CPU."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from octn_ros.field import NeuralModel
from octn_ros.field.compiled.arrays import Perceptron, WayBack
from octn_ros.field.compiled.evaluator import CompiledEvaluator
from octn_ros.field.compiled.model import encoding_of, perceptron_of, way_back_of, workers
from octn_ros.field.compiled.options import BRICK
from octn_ros.field.compiled.walk import MOST_VERTICES
from octn_ros.training.brick_kernel import Samples, Touched, adam_rows, look_up, pass_lane, sum_lane
from octn_ros.training.sampling import interpolated_count
from octn_ros.volume import Volume, VolumeGeometry

BRICK_SAMPLES = BRICK**3
# Independent of the number of threads, see brick_kernel.
_LANES = 8
_BETAS, _EPSILON = (0.9, 0.99), 1e-15


class BrickSampler:
    """Draws bricks such that every voxel, and every place between voxels, is equally likely to be sampled.

    A brick's first sample is drawn uniformly from all places at which any of its samples is inside the volume; the
    others count for nothing. The samples of a brick are neighbours, so a batch of bricks holds less news than a batch
    of lone voxels. Not thread-safe: it owns a random generator.

    Args:
        geometry: of the volume.
        seed: start of the random sequence.
    """

    def __init__(self, geometry: VolumeGeometry, seed: int) -> None:
        self._shape = np.array(geometry.shape)
        self._generator = np.random.default_rng(seed)

    def draw(self, count: int, interpolated: int) -> Samples:
        """Draw `count` bricks; the first `interpolated` of them are shifted by a random fraction of a voxel."""
        first = self._generator.integers(1 - BRICK, self._shape, (count, 3)).astype(np.float64)
        first[:interpolated] -= self._generator.random((interpolated, 3))
        place = first[:, :, None] + np.arange(BRICK)
        last = (self._shape - 1)[None, :, None]
        held = place.clip(0, last)
        cell = np.floor(held)
        return Samples(
            coordinates=(held * (2.0 / last) - 1.0).astype(np.float32),
            weights=(held == place).astype(np.float32),
            cell=cell.astype(np.int64),
            share=(held - cell).astype(np.float32),
        )


class BrickTrainer:
    """Fits a model in place, with the same loss and optimizer as the plain path but for two things: samples come in
    bricks, and Adam moves only the table rows that a step touches.

    The same seed gives the same model for any number of threads. CPU only, float32 only; not thread-safe itself, but
    several trainers may run at once.

    Args:
        model: the model that is trained.
        volume: the C-scan; kept in its own type.
        samples: samples of a step, of which whole bricks are made, one at least.
        seed: of the samples.
    """

    def __init__(self, model: NeuralModel, volume: Volume, samples: int, seed: int) -> None:
        self._model, self._voxels = model, np.ascontiguousarray(volume.array)
        low, high = volume.intensity_range
        self._low, self._gain = np.float32(low), np.float32(1.0 / (high - low))
        self._sampler = BrickSampler(volume.geometry, seed)
        self._encoding = encoding_of(model)
        self._bricks = max(1, round(samples / BRICK_SAMPLES))
        table = self._encoding.table
        most = _touched_at_most(self._encoding.scale, volume.geometry.shape)
        self._touched = Touched(
            rows=np.empty((self._bricks, most), np.int64),
            gradients=np.empty((self._bricks, most, table.shape[1]), np.float32),
            counts=np.zeros(self._bricks, np.int64),
            order=np.empty((self._bricks, most), np.int32),
            first=np.zeros((self._bricks, _LANES + 1), np.int64),
        )
        # Of all lanes, one after the other.
        self._distinct = np.empty(self._bricks * most, np.int64)
        self._gradient = np.empty((self._bricks * most, table.shape[1]), np.float32)
        self._moments = np.zeros((len(table), 2 * table.shape[1]), np.float32)
        self._place_of = np.zeros(len(table), np.int32)
        self._parameters = [
            p.detach().numpy() for layer in model.network.linear_layers for p in (layer.weight, layer.bias)
        ]
        self._perceptron = perceptron_of(model)
        self._back = way_back_of(self._perceptron)
        self._parameter_moments = [(np.zeros_like(p), np.zeros_like(p)) for p in self._parameters]
        self._step = 0
        self.trained: torch.nn.Module = model
        self.samples = 0
        self._compile()

    def step(self, rate: float, alpha: float, cancelled: Callable[[], bool]) -> float | None:
        """Do one step; return its mean squared error, None if it was cancelled and nothing has changed.

        Args:
            rate: Adam's learning rate.
            alpha: share of interpolated samples.
            cancelled: asked before the step and before anything changes.
        """
        if cancelled():
            return None
        bricks = self._sampler.draw(self._bricks, interpolated_count(self._bricks, alpha))
        samples = max(sample_count(bricks), 1)  # a single shifted brick can miss the volume
        gradients, squared_error = self._pass(bricks)
        if cancelled():
            return None
        self._step += 1
        factor = 2.0 / samples
        corrections = tuple(1.0 / (1.0 - beta**self._step) for beta in _BETAS)
        self._update_table(np.float32(rate), np.float32(factor), corrections)
        self._update_network(rate, [factor * g for g in gradients], corrections)
        self.samples += samples
        return squared_error / samples

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the model's intensities [N] at canonical points [N, 3]."""
        return CompiledEvaluator(self._model).evaluate(points)

    def _compile(self) -> None:
        """Run every kernel on nothing, so that no step of the fit waits for the compiler."""
        self._pass(self._sampler.draw(0, 0))
        self._update_table(np.float32(0.0), np.float32(0.0), (1.0, 1.0))
        self.evaluate(torch.zeros(1, 3))

    def _pass(self, bricks: Samples) -> tuple[list[NDArray[np.float32]], float]:
        perceptron, back = self._network()
        sums = Perceptron(*(np.zeros((_LANES, *np.shape(p)), np.float32) for p in perceptron))
        squared_error = np.zeros(_LANES)
        targets = np.empty((len(bricks.coordinates), BRICK_SAMPLES), np.float32)

        def lane(number: int) -> None:
            look_up(number, _LANES, self._voxels, self._low, self._gain, bricks, targets)
            pass_lane(
                number, _LANES, bricks, targets, self._encoding, perceptron, back, self._touched, sums, squared_error
            )

        _for_every_lane(lane)
        first, first_bias, more, more_bias, output, output_bias = (s.sum(axis=0) for s in sums)
        padded = [first, first_bias]
        for weight, bias in zip(more, more_bias, strict=True):
            padded += [weight, bias]
        padded += [output[None], np.array([output_bias])]
        gradients = [
            g[tuple(slice(size) for size in p.shape)] for g, p in zip(padded, self._parameters, strict=True)
        ]  # the padding is cut off again
        return gradients, float(squared_error.sum())

    def _update_table(self, rate: np.float32, factor: np.float32, corrections: tuple[float, ...]) -> None:
        beta1, beta2 = (np.float32(beta) for beta in _BETAS)
        correction1, correction2 = (np.float32(c) for c in corrections)

        ends = np.cumsum(np.diff(self._touched.first).sum(axis=0)).tolist()

        def lane(number: int) -> None:
            part = slice(ends[number - 1] if number else 0, ends[number])
            rows, gradient = self._distinct[part], self._gradient[part]
            count = sum_lane(number, self._touched, self._place_of, gradient, rows)
            adam_rows(
                rows[:count], self._encoding.table, gradient, self._moments, factor, rate,
                beta1, beta2, correction1, correction2, np.float32(_EPSILON),
            )  # fmt: skip

        _for_every_lane(lane)

    def _network(self) -> tuple[Perceptron, WayBack]:
        """Return the network as it is now, in arrays that are kept from step to step."""
        first, first_bias, more, more_bias, output, _ = self._perceptron
        padded = [first, first_bias]
        for weight, bias in zip(more, more_bias, strict=True):
            padded += [weight, bias]
        for into, parameter in zip([*padded, output[None]], self._parameters, strict=False):
            into[tuple(slice(size) for size in parameter.shape)] = parameter
        self._back.first[:] = first.T
        self._back.more[:] = more.transpose(0, 2, 1)
        return self._perceptron._replace(output_bias=np.float32(self._parameters[-1][0])), self._back

    def _update_network(
        self, rate: float, gradients: list[NDArray[np.float32]], corrections: tuple[float, ...]
    ) -> None:
        for parameter, (mean, square), gradient in zip(
            self._parameters, self._parameter_moments, gradients, strict=True
        ):
            mean += (1.0 - _BETAS[0]) * (gradient - mean)
            square += (1.0 - _BETAS[1]) * (gradient**2 - square)
            parameter -= rate * corrections[0] * mean / (np.sqrt(corrections[1] * square) + _EPSILON)


def _for_every_lane(job: Callable[[int], None]) -> None:
    """Do a job for every lane, on the kernels' threads and on this one, which would wait for them anyway."""
    # The threads share the iterator, which gives each number once: whoever is free takes the next lane.
    lanes = iter(range(_LANES))

    def take() -> None:
        for lane in lanes:
            job(lane)

    helpers = [workers().submit(take) for _ in range(min(torch.get_num_threads(), _LANES) - 1)]
    take()
    for helper in helpers:
        if not helper.cancel():
            helper.result()


def sample_count(bricks: Samples) -> int:
    """Return the number of samples inside the volume."""
    return int(bricks.weights.sum(axis=2, dtype=np.float64).prod(axis=1).sum())


def _touched_at_most(scale: NDArray[np.float32], shape: tuple[int, int, int]) -> int:
    """Return how many vertices the samples of one brick touch at most, over all levels."""
    total = 0
    for level in scale:
        cells = [(BRICK - 1) * float(s) / (n - 1) for s, n in zip(level, shape, strict=True)]
        total += math.prod(min(math.ceil(c) + 2, MOST_VERTICES) for c in cells)
    return total
