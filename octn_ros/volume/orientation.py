"""Arrays whose axes are in another order, or run the other way, than [bscan, axial, lateral]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ConfigurationError

AXES = ("bscan", "axial", "lateral")
FORWARD = (1, 1, 1)


def axis_order(axes: Sequence[str]) -> tuple[int, int, int]:
    """Return where the bscan, axial and lateral axes stand in an array with these axes.

    Args:
        axes: the names of the array's axes in its own order, ("axial", "lateral", "bscan") for instance.

    Raises:
        ConfigurationError: each of the three names has to be there once.
    """
    if sorted(axes) != sorted(AXES):
        raise ConfigurationError(f"expected the axes bscan, axial and lateral in some order, got {', '.join(axes)}")
    bscan, axial, lateral = (list(axes).index(axis) for axis in AXES)
    return bscan, axial, lateral


def check_scan_signs(signs: Sequence[int]) -> None:
    """Check the directions of the (bscan, axial, lateral) axes.

    Raises:
        ConfigurationError: they are not three times 1 or -1.
    """
    if len(signs) != 3 or any(sign not in (1, -1) for sign in signs):
        raise ConfigurationError(f"expected a sign 1 or -1 for each of (bscan, axial, lateral), got {tuple(signs)}")


def orient(array: NDArray[Any], order: tuple[int, int, int], signs: Sequence[int]) -> NDArray[Any]:
    """Return a view with axes [bscan, axial, lateral] of which those with sign -1 run backwards.

    Args:
        array: three axes in any order.
        order: from `axis_order`.
        signs: directions of the (bscan, axial, lateral) axes: -1 where the scanner stores them mirrored.
    """
    return np.transpose(array, order)[tuple(slice(None, None, sign) for sign in signs)]
