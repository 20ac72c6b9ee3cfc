"""How long a plan takes on a full volume, for each field and method, in one run on one machine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from octn_ros.evaluation.benchmark import Progress
from octn_ros.evaluation.raster_config import SYSTEM, RasterBenchConfig
from octn_ros.evaluation.raster_fields import FilteredVolume, filtered, neural_field
from octn_ros.evaluation.raster_methods import BASELINE, Method, methods
from octn_ros.field import Field, InterpolatedField
from octn_ros.planning import RasterPattern
from octn_ros.planning.baseline import baseline_surface, knn_baseline
from octn_ros.simulation import make_phantom, named_phantom

# The median of a full volume takes minutes and would be all that its ratio tells.
_TIMED_FILTERS = ("raw", "gaussian")
_WARM_REPEATS = 3


@dataclass(frozen=True)
class Timing:
    """Seconds to plan, and how many times that the baseline on the same voxels takes.

    Attributes:
        seconds: first plan, filtering included; what the field itself took to fit is not.
        seconds_warm: median of further plans with everything at hand that can be.
        ratio: baseline's `seconds` over this one's.
        ratio_warm: baseline's `seconds_warm` over this one's.
        ratio_filtered: the same as `ratio` with the baseline after the Gaussian, whatever this one was made of.
    """

    seconds: float
    seconds_warm: float
    ratio: float
    ratio_warm: float
    ratio_filtered: float = math.nan


def measure_times(
    config: RasterBenchConfig, device: str, pattern_of: Callable[..., RasterPattern], progress: Progress
) -> dict[tuple[str, str], Timing]:
    """Time every method on fields of one large phantom; keys are (field, method) as in the table.

    Args:
        config: shape of the volume, side and spacing of the raster.
        device: where the fields lie.
        pattern_of: makes the raster from geometry, side and spacing.
        progress: told how far it is.
    """
    phantom = make_phantom(named_phantom(f"wavy{SYSTEM}", shape=config.timing_shape, seed=config.seed))
    pattern = pattern_of(phantom.volume.geometry, config.timing_side_m, config.spacing_m)
    times: dict[tuple[str, str], Timing] = {}
    progress("timing", 0.2, "fitting a field to it")
    neural = neural_field(filtered(phantom.volume, "raw"), device, config).field
    for number, name in enumerate(_TIMED_FILTERS):
        progress("timing", 0.4 + 0.3 * number, f"{name} voxels, {len(pattern.points_m)} waypoints")
        voxels = filtered(phantom.volume, name)
        cold, warm = _baseline(voxels, pattern)
        times[f"voxels-{name}", BASELINE] = Timing(cold, warm, 1.0, 1.0)
        began = time.perf_counter()
        field = InterpolatedField(voxels.volume, device)
        made = time.perf_counter() - began
        for kind, made_s, timed in (("interpolated", made, field), ("neural", 0.0, neural)):
            for method, search in methods(config, descents=False).items():
                seconds, seconds_warm = _plan(search, timed, pattern)
                seconds += voxels.seconds + made_s
                times[f"{kind}-{name}", method] = Timing(seconds, seconds_warm, cold / seconds, warm / seconds_warm)
    return against_filtered(times)


def against_filtered(times: dict[tuple[str, str], Timing]) -> dict[tuple[str, str], Timing]:
    """Return the times with each also held against the baseline after the Gaussian."""
    reference = times["voxels-gaussian", BASELINE].seconds
    return {key: replace(timing, ratio_filtered=reference / timing.seconds) for key, timing in times.items()}


def _baseline(voxels: FilteredVolume, pattern: RasterPattern) -> tuple[float, float]:
    first = knn_baseline(voxels.volume, pattern)
    surface = baseline_surface(voxels.volume)
    warm = sorted(knn_baseline(surface, pattern).seconds["query"] for _ in range(_WARM_REPEATS))
    return voxels.seconds + sum(first.seconds.values()), warm[_WARM_REPEATS // 2]


def _plan(search: Method, field: Field, pattern: RasterPattern) -> tuple[float, float]:
    seconds = []
    for _ in range(1 + _WARM_REPEATS):
        began = time.perf_counter()
        search(field, pattern)
        seconds.append(time.perf_counter() - began)
    return seconds[0], sorted(seconds[1:])[_WARM_REPEATS // 2]
