"""When a motion passes each place of its path, so that speeds and accelerations stay within their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The most that bends may take of an acceleration limit; what they leave is for gathering and losing speed.
_BEND_SHARE = 0.5
# A place that moves nothing (two equal poses) is passed at this rate, in metres of the parameter per second.
_FASTEST = 1e3


@dataclass(frozen=True, eq=False)
class Quantity:
    """Something that moves along a path: the place of a point, or an orientation.

    Attributes:
        values: its value at each place [K, 3], metres or radians.
        speed: largest speed [K] or for all places, per second.
        acceleration: largest acceleration, per second squared; infinite where only the speed is limited.
    """

    values: NDArray[np.float64]
    speed: NDArray[np.float64] | float
    acceleration: float = np.inf


def passing_rates(
    parameter: NDArray[np.float64], stops: NDArray[np.bool_], quantities: list[Quantity]
) -> NDArray[np.float64]:
    """Return the rate du/dt at each place of a path, as fast as the limits allow; pure and thread-safe.

    The squared rate x = (du/dt)^2 makes the problem linear: |q''| x + |q'| |dx/du| / 2 bounds the acceleration of every
    quantity q(u) (triangle inequality). x is limited by the speeds and by the bends of the path, then by what can be
    gathered since the stop before and lost until the stop after, as in time-optimal path parameterisation (Bobrow,
    Dubowsky and Gibson 1985), with a fixed share of the acceleration for bends.

    Args:
        parameter: u at each place [K], rising.
        stops: where the motion halts [K]; a path may bend sharply there. The first and the last place are among them.
        quantities: what is limited.

    Returns:
        Rates [K], 0 at stops.
    """
    steps = np.diff(parameter)
    limit = np.full(len(parameter), _FASTEST**2)
    gain = np.full(len(steps), np.inf)
    derivatives = [_derivatives(parameter, stops, quantity.values) for quantity in quantities]
    for quantity, (first, second) in zip(quantities, derivatives, strict=True):
        with np.errstate(divide="ignore"):
            limit = np.minimum(limit, (quantity.speed / first) ** 2)
            limit = np.minimum(limit, _BEND_SHARE * quantity.acceleration / second)
    for quantity, (first, second) in zip(quantities, derivatives, strict=True):
        if not np.isfinite(quantity.acceleration):
            continue
        bending = second * limit
        left = quantity.acceleration - np.maximum(bending[1:], bending[:-1])
        with np.errstate(divide="ignore"):
            gain = np.minimum(gain, 2.0 * left / np.maximum(first[1:], first[:-1]))
    limit = np.where(stops, 0.0, limit)
    # What can have been gathered at a place is the least of every limit before it plus the gain since, hence running
    # minima over the limits less the gain summed up; the same from the other end for what must be lost.
    gathered = np.concatenate(([0.0], np.cumsum(np.minimum(gain, 1e12) * steps)))
    limit = gathered + np.minimum.accumulate(limit - gathered)
    limit = np.minimum.accumulate((limit + gathered)[::-1])[::-1] - gathered
    return np.sqrt(np.where(stops, 0.0, np.maximum(limit, 0.0)))


def passing_times(parameter: NDArray[np.float64], rates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return when each place [K] is passed, seconds from the first, for a squared rate linear in between.

    Infinite beyond a place where a rate of 0 follows another: too small a rate beside others is rounded to 0.
    """
    with np.errstate(divide="ignore"):
        legs = 2.0 * np.diff(parameter) / (rates[1:] + rates[:-1])
    return np.concatenate(([0.0], np.cumsum(legs)))


def _derivatives(
    parameter: NDArray[np.float64], stops: NDArray[np.bool_], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return |dq/du| and |d2q/du2| at each place [K]; at a stop those of the place beside it, for it has two sides."""
    before, after = np.diff(parameter)[:-1, None], np.diff(parameter)[1:, None]
    slopes = np.diff(values, axis=0) / np.diff(parameter)[:, None]
    first, second = np.zeros(len(values)), np.zeros(len(values))
    first[1:-1] = np.linalg.norm((slopes[:-1] * after + slopes[1:] * before) / (before + after), axis=1)
    second[1:-1] = np.linalg.norm(2.0 * (slopes[1:] - slopes[:-1]) / (before + after), axis=1)
    # A speed is the same on both sides of a place only where the path is smooth, so the faster side counts.
    speed = np.linalg.norm(slopes, axis=1)
    first[1:-1] = np.maximum(first[1:-1], np.maximum(speed[1:], speed[:-1]))
    first[0], first[-1] = speed[0], speed[-1]
    second[stops] = 0.0
    return first, second
