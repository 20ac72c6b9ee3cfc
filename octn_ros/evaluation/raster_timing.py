"""How long a plan takes on a full volume, for each field and method, in one run on one machine."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from octn_ros.evaluation.benchmark import Progress
from octn_ros.evaluation.raster_config import SYSTEM, RasterBenchConfig
from octn_ros.evaluation.raster_fields import FilteredVolume, NamedField, filtered, neural_field, phantom_config
from octn_ros.evaluation.raster_methods import BASELINE, DESCENDED, DESCENTS, ON_EVERY_FIELD, methods
from octn_ros.field import InterpolatedField, NeuralField
from octn_ros.planning import RasterPattern, SurfaceSearch
from octn_ros.planning.baseline import knn_baseline
from octn_ros.simulation import Phantom, make_phantom

# The median of a full volume takes half a minute and would be nearly all that its ratio tells.
_TIMED_FILTERS = ("raw", "gaussian")
_REPEATS = 3
# Auxiliary outlier checking and rejection, which the paper leaves out of its times.
_CHECK = "check"


@dataclass(frozen=True)
class Timing:
    """Seconds to plan; what loads the volume, makes the field or fits it is in none of them.

    Attributes:
        filter_s: the filter that the voxels went through, 0 for none.
        core_s: core operations: coarse search and refinement, or the baseline's surface, tree and look-up.
        check_s: outlier checking and rejection.
        warm_s: core operations with everything kept that can be: the baseline's look-up alone.
    """

    filter_s: float
    core_s: float
    check_s: float
    warm_s: float


@dataclass(frozen=True)
class TimeRatios:
    """The baseline's time over a method's; NaN where there is nothing to compare.

    Attributes:
        same_voxels: core operations, baseline on the same voxels, their filter counted on both sides.
        filtered_baseline: core operations, baseline after the Gaussian with the filter counted; for a field of
            unfiltered voxels only if it is neural, since that alone claims to need no filter.
        with_check: as `same_voxels`, with the method's outlier checking.
        warm: with filtered voxels, surface and KD-tree kept.
    """

    same_voxels: float = math.nan
    filtered_baseline: float = math.nan
    with_check: float = math.nan
    warm: float = math.nan


@dataclass(frozen=True, eq=False)
class TimedSearch:
    """One plan on the full volume.

    Attributes:
        field: as in the table; a neural one ends in what evaluates it, "-compiled" or "-torch".
        method: as in the table.
        search: what was found.
        timing: how long it took.
        ratios: against the baseline.
    """

    field: str
    method: str
    search: SurfaceSearch
    timing: Timing
    ratios: TimeRatios


def measure_times(
    config: RasterBenchConfig, device: str, pattern_of: Callable[..., RasterPattern], progress: Progress
) -> tuple[Phantom, RasterPattern, list[TimedSearch]]:
    """Time every method on fields of one large phantom, on as many threads as the process has.

    Everything is run once before it is timed, so that no compiling is counted, and then three times, of which the
    median counts; gradient descent, a thousand steps that compile nothing new, once.

    Args:
        config: shape of the volume, side and spacing of the raster.
        device: where the fields lie.
        pattern_of: makes the raster from geometry, side and spacing.
        progress: told how far it is.

    Returns:
        The phantom, the raster on it, and what was timed.
    """
    phantom = make_phantom(phantom_config(f"wavy{SYSTEM}", config, config.timing_shape))
    pattern = pattern_of(phantom.volume.geometry, config.timing_side_m, config.spacing_m)
    runs: list[tuple[str, str, SurfaceSearch, Timing]] = []
    for number, name in enumerate(_TIMED_FILTERS):
        share = 0.1 + 0.45 * number
        progress("timing", share, f"{name} voxels, filter, baseline and fit")
        voxels = [filtered(phantom.volume, name) for _ in range(_REPEATS if name != "raw" else 1)]
        filter_s = statistics.median(entry.seconds for entry in voxels) if name != "raw" else 0.0
        runs.append((f"voxels-{name}", BASELINE, *_baseline(voxels[0], pattern, filter_s)))
        for entry in _fields(voxels[0], device, config):
            progress("timing", share + 0.2, f"{entry.name}, {len(pattern.points_m)} waypoints")
            # Once for each field, with the back end it has by itself.
            plain = "-".join(entry.name.split("-")[:2])
            descents = plain in DESCENDED and not any(field.startswith(plain) for field, _, _, _ in runs)
            for method, search_with in methods(config, ON_EVERY_FIELD + (DESCENTS if descents else ())).items():
                repeats = 1 if method in DESCENTS else _REPEATS
                if repeats > 1:
                    search_with(entry.field, pattern)
                searches = [search_with(entry.field, pattern) for _ in range(repeats)]
                runs.append((entry.name, method, searches[-1], _timing(searches, filter_s)))
    ratios = time_ratios({(field, method): timing for field, method, _, timing in runs})
    return phantom, pattern, [TimedSearch(*run, ratios[run[:2]]) for run in runs]


def time_ratios(times: Mapping[tuple[str, str], Timing]) -> dict[tuple[str, str], TimeRatios]:
    """Return the ratios of times by (field, method), baselines among them as ("voxels-FILTER", "baseline")."""
    against = times["voxels-gaussian", BASELINE]
    filtered_s = against.filter_s + against.core_s
    ratios = {}
    for (field, method), timing in times.items():
        kind, name = field.split("-")[:2]
        base = times[f"voxels-{name}", BASELINE]
        own = timing.filter_s + timing.core_s
        compared = kind == "neural" or name != "raw"
        ratios[field, method] = TimeRatios(
            same_voxels=(base.filter_s + base.core_s) / own,
            filtered_baseline=filtered_s / own if compared else math.nan,
            with_check=(base.filter_s + base.core_s) / (own + timing.check_s),
            warm=base.warm_s / timing.warm_s,
        )
    return ratios


def _fields(voxels: FilteredVolume, device: str, config: RasterBenchConfig) -> Iterator[NamedField]:
    yield NamedField(f"interpolated-{voxels.name}", InterpolatedField(voxels.volume, device), voxels)
    fitted = neural_field(voxels, device, config)
    field = fitted.field
    assert isinstance(field, NeuralField)
    backends = [field.backend] + (["torch"] if field.backend != "torch" else [])
    for backend in backends:
        timed = NeuralField(field.model, field.config, field.description, backend)
        yield NamedField(f"{fitted.name}-{backend}", timed, voxels)


def _baseline(voxels: FilteredVolume, pattern: RasterPattern, filter_s: float) -> tuple[SurfaceSearch, Timing]:
    searches = [knn_baseline(voxels.volume, pattern) for _ in range(1 + _REPEATS)][1:]
    core = statistics.median(sum(search.seconds.values()) for search in searches)
    warm = statistics.median(search.seconds["query"] for search in searches)
    return searches[-1], Timing(filter_s, core, 0.0, warm)


def _timing(searches: list[SurfaceSearch], filter_s: float) -> Timing:
    stages = [search.seconds for search in searches]
    check = statistics.median(seconds.get(_CHECK, 0.0) for seconds in stages)
    core = statistics.median(sum(s for stage, s in seconds.items() if stage != _CHECK) for seconds in stages)
    return Timing(filter_s, core, check, core)
