"""The fits of a benchmark: a preset of training, made repeatable."""

from __future__ import annotations

import dataclasses

from octn_ros.errors import ConfigurationError
from octn_ros.training import PRESETS, FitConfig


def preset_fit(preset: str, steps: int, seed: int) -> FitConfig:
    """Return a preset with so many steps (0 for its own), a seed, and no time budget, whose fits follow the clock.

    Raises:
        ConfigurationError: there is no such preset.
    """
    if preset not in PRESETS:
        raise ConfigurationError(f"preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
    config = PRESETS[preset]
    return dataclasses.replace(config, steps=steps or config.steps, time_budget_s=0.0, seed=seed)
