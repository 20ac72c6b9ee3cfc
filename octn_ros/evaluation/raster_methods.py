"""The methods of the raster table: ours, and the paper's three as it describes them."""

from __future__ import annotations

from collections.abc import Callable

from octn_ros.evaluation.raster_config import RasterBenchConfig
from octn_ros.field import Field
from octn_ros.planning import (
    RasterPattern,
    SurfaceSearch,
    SurfaceSearchConfig,
    find_surface,
)
from octn_ros.planning.paper_methods import PaperConfig, paper_newton, paper_sgd

Method = Callable[[Field, RasterPattern], SurfaceSearch]
BASELINE = "baseline"
# On every field; plain gradient descent only where its thousand steps are waited for.
ON_EVERY_FIELD = ("newton", "least_squares", "paper-newton")
DESCENTS = ("sgd", "paper-sgd")


def methods(config: RasterBenchConfig, descents: bool) -> dict[str, Method]:
    """Return the methods by name, all with their defaults and tau as the paper estimates it."""

    def ours(refinement: str) -> Method:
        settings = SurfaceSearchConfig(refinement=refinement, descent_steps=config.descent_steps)
        return lambda field, pattern: find_surface(field, pattern, None, settings)

    paper = PaperConfig(sgd_steps=config.descent_steps)
    every: dict[str, Method] = {
        "newton": ours("newton"),
        "least_squares": ours("least_squares"),
        "sgd": ours("sgd"),
        "paper-newton": lambda field, pattern: paper_newton(field, pattern, None, paper),
        "paper-sgd": lambda field, pattern: paper_sgd(field, pattern, None, paper),
    }
    return {name: every[name] for name in ON_EVERY_FIELD + (DESCENTS if descents else ())}
