"""Numbers as message fields hold them."""

from __future__ import annotations

from array import array

import numpy as np


def to_bytes_field(data: bytes | memoryview) -> array[int]:
    """Return what a uint8[] field takes without a Python loop over its items."""
    field = array("B")
    field.frombytes(data)
    return field


def shortest_decimal(value: float) -> float:
    """Return what the caller wrote into a float32 field: 5e-05, not 4.999999873689376e-05."""
    return float(str(np.float32(value)))
