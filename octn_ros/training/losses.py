"""The losses of a fit's steps, fetched from the device several at once."""

from __future__ import annotations

import torch
from torch import Tensor

# Steps between two readings on a GPU. A reading waits until the device has done all that it was told; between two the
# device is told of the next steps while it does the last. So many steps late a fit that diverges is noticed.
_PERIOD_STEPS = 16


class LossReader:
    """Keeps losses where they were computed, and reads them now and then: on the CPU at once.

    Args:
        device: where they are computed.
    """

    def __init__(self, device: torch.device) -> None:
        self._period = 1 if device.type == "cpu" else _PERIOD_STEPS
        self._unread: list[Tensor] = []

    def add(self, loss: Tensor | float) -> list[float]:
        """Take the loss of a step; return those that are read by it, in order."""
        self._unread.append(torch.as_tensor(loss, dtype=torch.float64))
        return self.read() if len(self._unread) >= self._period else []

    def read(self) -> list[float]:
        """Return all that are unread, in order."""
        unread, self._unread = self._unread, []
        losses: list[float] = torch.stack(unread).tolist() if unread else []
        return losses
