"""Where the waypoints of each method lie against the true surface, as PNG."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from octn_ros.demo import canvas
from octn_ros.planning import RasterPattern, SurfaceSearch
from octn_ros.simulation import Phantom

_LIMIT_UM = 40.0
_LINE_COLOURS = ("#8a9099", "#1f5fa8", "#c8641b", "#2a8f5b", "#7a4ea3")


def raster_picture(
    title: str, phantom: Phantom, pattern: RasterPattern, searches: Mapping[str, SurfaceSearch]
) -> bytes:
    """Draw the distance to the true surface over the raster for each search, and the depths along its middle line.

    Given-up waypoints are left white; the artefacts of the phantom are shaded.
    """
    x_mm, y_mm = pattern.points_m.T * 1e3
    masked = phantom.artefact_mask(*pattern.points_m.T)
    with canvas.figure(canvas.WIDTH_IN, 5.6) as figure:
        figure.suptitle(title, fontsize=10)
        grid = figure.add_gridspec(2, len(searches), height_ratios=(1.2, 1.0))
        axes: Axes | None = None
        for column, (name, search) in enumerate(searches.items()):
            axes = figure.add_subplot(grid[0, column])
            kept = ~search.given_up
            points = np.column_stack([pattern.points_m, search.depth_m])[kept]
            distance_um = phantom.surface.distance(points) * 1e6 if len(points) else np.zeros(0)
            axes.plot(x_mm[masked], y_mm[masked], "s", color="#dcdfe3", markersize=3.5, zorder=0)
            axes.scatter(
                x_mm[kept], y_mm[kept], c=distance_um, s=3, marker="s", cmap="RdBu_r", vmin=-_LIMIT_UM, vmax=_LIMIT_UM
            )
            axes.set(aspect="equal", xlabel="lateral x (mm)", ylabel="bscan y (mm)" if column == 0 else "")
            axes.set_title(name.replace(", ", "\n"), fontsize=8)
        if axes is not None:
            colours = ScalarMappable(Normalize(-_LIMIT_UM, _LIMIT_UM), "RdBu_r")
            canvas.colour_bar(figure, colours, axes, "distance to the true surface (um)")
        _draw_line(figure.add_subplot(grid[1, :]), phantom, pattern, searches)
        return canvas.png(figure)


def _draw_line(axes: Axes, phantom: Phantom, pattern: RasterPattern, searches: Mapping[str, SurfaceSearch]) -> None:
    middle = pattern.segment == np.median(np.unique(pattern.segment)).astype(int)
    x, y = pattern.points_m[middle].T
    order = np.argsort(x)
    true_um = phantom.surface_depth_m(x, y)[order] * 1e6
    for (name, search), colour in zip(searches.items(), _LINE_COLOURS, strict=False):
        axes.plot(x[order] * 1e3, search.depth_m[middle][order] * 1e6, ".-", color=colour, markersize=3, linewidth=0.8,
                  label=name)  # fmt: skip
    axes.plot(x[order] * 1e3, true_um, color=canvas.INK, linewidth=1.2, label="true surface")
    margin = max(60.0, 0.3 * float(np.ptp(true_um)))
    axes.set(xlabel="lateral x (mm), middle line", ylabel="depth z (um)")
    axes.set_ylim(true_um.max() + margin, true_um.min() - margin)
    axes.legend(fontsize=7, ncols=3, loc="lower left")
