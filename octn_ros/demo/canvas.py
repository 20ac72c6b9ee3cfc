"""The paper the pictures are drawn on: size, style, scale, colour bars, PNG."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from octn_ros.volume.geometry import VolumeGeometry

DOTS_PER_INCH = 150
WIDTH_IN = 10.0
INK = "#22262b"
BLUE, ORANGE, RED = "#1f5fa8", "#c8641b", "#c22b2b"
DEPTH_COLOURS = "viridis"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": INK,
    "axes.edgecolor": "#8a9099",
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.8,
    "xtick.color": "#555b63",
    "ytick.color": "#555b63",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


@contextmanager
def figure(width_in: float, height_in: float) -> Iterator[Figure]:
    """Yield a new figure of this size in inches; draw and save it inside, where the style holds."""
    with matplotlib.rc_context(STYLE):
        drawn = Figure(figsize=(width_in, height_in), dpi=DOTS_PER_INCH, layout="constrained")
        FigureCanvasAgg(drawn)
        yield drawn


def png(drawn: Figure) -> bytes:
    """Return a figure as PNG on white."""
    stream = io.BytesIO()
    drawn.savefig(stream, format="png", facecolor="white")
    return stream.getvalue()


def edges_mm(geometry: VolumeGeometry) -> tuple[float, float, float, float, float, float]:
    """Return the outer edges (x0, x1, y0, y1, z0, z1) of the voxels, half a voxel beyond the outermost centres."""
    (d, h, w), (x, y, z) = geometry.spacing_m, geometry.origin_m
    extent_x, extent_y, extent_z = geometry.extent_m
    return (
        (x - w / 2) * 1e3, (x + extent_x + w / 2) * 1e3,
        (y - d / 2) * 1e3, (y + extent_y + d / 2) * 1e3,
        (z - h / 2) * 1e3, (z + extent_z + h / 2) * 1e3,
    )  # fmt: skip


def height_in(panels: int, width: float, height: float, colour_bars: int, legend_in: float = 0.0) -> float:
    """Return the figure height in inches at which panels of `width` x `height` fill the page, within what it bears."""
    panel = (WIDTH_IN - 0.7 - 0.75 * colour_bars - 0.2 * panels) / panels
    return float(np.clip(panel * height / width, 1.0, 6.0)) + 0.85 + legend_in


def colour_bar(drawn: Figure, mapped: ScalarMappable, axes: Axes, label: str) -> None:
    """Add a colour bar exactly as high as the picture beside it."""
    drawn.colorbar(mapped, cax=axes.inset_axes((1.03, 0.0, 0.045, 1.0)), label=label)


def colour_of(colours: str, share: float) -> tuple[float, float, float, float]:
    """Return the colour at a share, 0 to 1, of a named colour map."""
    return matplotlib.colormaps[colours](share)
