"""A fit that goes wrong is noticed, and the last good state of its model kept."""

from __future__ import annotations

import math

from torch import Tensor, nn

# A constant field has an error of one variance. At the presets' learning rate Adam's first steps overshot to at most 4
# variances on phantoms. Ten times that rate leapt to 1e4 and came back within a few steps, a hundred times never did.
EXPLODED = 10.0
PATIENCE_STEPS = 10
SNAPSHOT_PERIOD_STEPS = 50  # a copy of all parameters costs a fraction of a step


class DivergenceGuard:
    """Watches losses, copies the parameters now and then while they are good, and puts them back.

    Args:
        model: what is trained.
        variance: of the intensities: the mean squared error of the best constant.
    """

    def __init__(self, model: nn.Module, variance: float) -> None:
        self._model, self._variance = model, variance
        self._good: dict[str, Tensor] = {}
        self._good_step = -1
        self._bad_steps = 0

    def diverged(self, loss: float) -> bool:
        """Take the mean squared error of a step; return whether the fit is lost."""
        if not math.isfinite(loss):
            return True
        self._bad_steps = self._bad_steps + 1 if loss > EXPLODED * self._variance else 0
        return self._bad_steps >= PATIENCE_STEPS

    def keep(self, step: int, error: float) -> None:
        """Copy the parameters if `error`, the mean squared one after `step` steps, is below that of any constant."""
        due = self._good_step < 0 or step - self._good_step >= SNAPSHOT_PERIOD_STEPS
        if due and error < self._variance:
            state = self._model.state_dict()
            if self._good:
                for name, value in state.items():
                    self._good[name].copy_(value)
            else:
                self._good = {name: value.detach().clone() for name, value in state.items()}
            self._good_step = step

    def restore(self) -> int | None:
        """Put the last good parameters back; return after how many steps they were, None if there are none."""
        if self._good_step < 0:
            return None
        self._model.load_state_dict(self._good)
        return self._good_step
