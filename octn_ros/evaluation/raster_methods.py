"""The methods of the raster table: ours, and the paper's three as it describes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
# On every phantom; then where there is time for it; then where its thousand steps are waited for.
EVERYWHERE = ("newton", "least_squares")
ON_EVERY_FIELD = (*EVERYWHERE, "paper-newton")
DESCENTS = ("sgd", "paper-sgd")
# Gradient descent is waited for on these fields, and they are drawn.
DESCENDED = ("interpolated-gaussian", "neural-raw")


def methods(config: RasterBenchConfig, names: Sequence[str]) -> dict[str, Method]:
    """Return the methods of these names, all with their defaults and tau as the paper estimates it."""

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
    return {name: every[name] for name in names}
