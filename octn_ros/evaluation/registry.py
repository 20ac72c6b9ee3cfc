"""The benchmarks by name; each module is loaded when it is asked for, since they load torch."""

from __future__ import annotations

from importlib import import_module

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation.benchmark import Benchmark

# Name on the command line -> module with `run`.
MODULES = {
    "all": "octn_ros.evaluation.all_benchmarks",
    "alpha": "octn_ros.evaluation.alpha",
    "band": "octn_ros.evaluation.band",
    "bscan": "octn_ros.evaluation.bscan",
    "compare": "octn_ros.evaluation.compare",
    "curve": "octn_ros.evaluation.curve",
    "raster": "octn_ros.evaluation.raster",
    "slices": "octn_ros.evaluation.slices",
    "sparse": "octn_ros.evaluation.sparse",
    "speed": "octn_ros.evaluation.speed",
}
# Those that need the truth, and so take no folder of scans.
PHANTOMS_ALONE = ("raster", "speed")


def benchmark(name: str) -> Benchmark:
    """Return the benchmark of that name.

    Raises:
        ConfigurationError: there is none.
    """
    if name not in MODULES:
        raise ConfigurationError(f"benchmark: expected one of {', '.join(sorted(MODULES))}, got {name!r}")
    run: Benchmark = import_module(MODULES[name]).run
    return run
