"""Tissue that moves under the probe, and the fiducials by which that is noticed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class TissueMotionConfig:
    """How the tissue moves, along the axes of the OCT frame, and how well that is measured."""

    shift_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "where the tissue lies, from its place at the start", unit="m", low=-0.05, high=0.05
    )
    drift_m_s: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "how fast it drifts away from there", unit="m/s", low=-0.1, high=0.1
    )
    tracker_noise_m: float = setting(
        2e-6, "standard deviation of a measured place of the fiducials along each axis", unit="m", low=0.0, high=0.01
    )

    def __post_init__(self) -> None:
        check_settings(self)


class TissueMotion:
    """Where the tissue is, and where its fiducials are seen; not thread-safe.

    A change of the configuration takes effect at once: the shift is a jump, the drift begins at the time of the change.

    Args:
        config: how it moves.
        now_s: present time, seconds of any clock.
        seed: of the tracker's noise.
    """

    def __init__(self, config: TissueMotionConfig, now_s: float, seed: int = 0) -> None:
        self._config, self._since_s, self._drifted = config, now_s, np.zeros(3)
        self._generator = np.random.default_rng((seed, 2))

    def change(self, config: TissueMotionConfig, now_s: float) -> None:
        """Move otherwise from now on."""
        if config != self._config:
            self._drifted = self.place_m(now_s) - np.array(self._config.shift_m)
            self._config, self._since_s = config, now_s

    def place_m(self, now_s: float) -> NDArray[np.float64]:
        """Return where the tissue lies, from its place at the start [3], metres in the OCT frame."""
        drifted = self._drifted + np.array(self._config.drift_m_s) * max(now_s - self._since_s, 0.0)
        return np.asarray(np.array(self._config.shift_m) + drifted, dtype=np.float64)

    def measured_m(self, now_s: float) -> NDArray[np.float64]:
        """Return the same as the tracker sees it: with its noise, drawn anew at each call."""
        return self.place_m(now_s) + self._config.tracker_noise_m * self._generator.normal(size=3)
