"""The pictures of a closed loop's report, as PNG bytes; see `pictures` for the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.demo.ablation_request import AblationRequest
from octn_ros.demo.canvas import BLUE, DEPTH_COLOURS, INK, ORANGE
from octn_ros.demo.closed_loop_result import PassFigures, ascan_places
from octn_ros.volume.geometry import VolumeGeometry


def depth_map_picture(removed_m: NDArray[np.float64], request: AblationRequest, geometry: VolumeGeometry) -> bytes:
    """Draw what is gone [bscan, lateral] in truth, and what that is off the request, with rectangle and band."""
    x0, x1, y0, y1, _, _ = canvas.edges_mm(geometry)
    removed = 1e6 * removed_m
    with canvas.figure(canvas.WIDTH_IN, canvas.height_in(2, x1 - x0, y1 - y0, colour_bars=2)) as figure:
        gone, off = figure.subplots(1, 2, sharex=True, sharey=True)
        extent = (x0, x1, y1, y0)
        shown = gone.imshow(removed, cmap=DEPTH_COLOURS, extent=extent, vmin=0.0, interpolation="nearest")
        asked = np.zeros_like(removed)
        (left, top), (right, bottom) = request.corners_m
        places = ascan_places(geometry)
        asked[request.inside(*places, 0.0)] = 1e6 * request.depth_m
        inner = request.inside(*places, request.laser.spot_radius_m)
        limit = max(1.5 * float(np.abs(removed - asked)[inner].max()), 1.0)
        error = off.imshow(
            removed - asked, cmap="RdBu_r", extent=extent, vmin=-limit, vmax=limit, interpolation="nearest"
        )
        for axes in (gone, off):
            for band, style in ((0.0, "-"), (request.laser.spot_radius_m, "--")):
                corner = (1e3 * (left + band), 1e3 * (top + band))
                sides = 1e3 * (right - left - 2 * band), 1e3 * (bottom - top - 2 * band)
                axes.add_patch(Rectangle(corner, *sides, fill=False, edgecolor=INK, linestyle=style, linewidth=0.9))
            axes.set_xlabel("lateral x (mm)")
        gone.set_ylabel("bscan y (mm)")
        gone.set_title("Depth gone")
        off.set_title("Depth gone less depth asked for")
        canvas.colour_bar(figure, shown, gone, "um")
        canvas.colour_bar(figure, error, off, "um")
        return canvas.png(figure)


def passes_picture(passes: Sequence[PassFigures], requested_um: float) -> bytes:
    """Draw the depth after each pass, in truth and as the fitted fields measure it, against the request."""
    with canvas.figure(canvas.WIDTH_IN, 3.4) as figure:
        axes = figure.subplots()
        number = np.arange(len(passes) + 1)
        axes.plot(number, [0.0, *(done.true_um for done in passes)], "o-", color=BLUE, label="gone, in truth")
        axes.plot(
            number, [0.0, *(done.measured_um for done in passes)], "s", color=ORANGE, fillstyle="none", markersize=9,
            label="gone, by the fields fitted to the scans",
        )  # fmt: skip
        axes.axhline(requested_um, color=INK, linewidth=0.9, linestyle="--", label="asked for")
        axes.set_xlabel("passes")
        axes.set_ylabel("depth inside the band, median (um)")
        axes.set_xticks(number)
        axes.grid(color="#e3e6ea", linewidth=0.8)
        axes.legend(loc="lower right")
        return canvas.png(figure)


def profile_picture(
    surfaces_m: Sequence[NDArray[np.float64]],
    truth_m: Sequence[NDArray[np.float64]],
    lateral_m: NDArray[np.float64],
    truth_lateral_m: NDArray[np.float64],
) -> bytes:
    """Draw the surface along one B-scan before and after the passes: of the fitted fields, and the true ones.

    Args:
        surfaces_m: depth of the fields' surfaces [lateral], one for each scan.
        truth_m: the true depths [lateral of the truth], one for each scan.
        lateral_m: x of the fields' columns.
        truth_lateral_m: x of the truth's columns.
    """
    with canvas.figure(canvas.WIDTH_IN, 3.8) as figure:
        axes = figure.subplots()
        shades = np.linspace(0.0, 0.85, len(surfaces_m))
        for number, (surface, truth, shade) in enumerate(zip(surfaces_m, truth_m, shades, strict=True)):
            colour = canvas.colour_of(DEPTH_COLOURS, float(shade))
            axes.plot(1e3 * truth_lateral_m, 1e3 * truth, color=INK, linewidth=0.8)
            label = "before" if number == 0 else f"after pass {number}"
            axes.plot(1e3 * lateral_m, 1e3 * surface, color=colour, linewidth=1.4, alpha=0.9, label=label)
        axes.invert_yaxis()
        axes.set_xlabel("lateral x (mm)")
        axes.set_ylabel("depth z (mm)")
        axes.grid(color="#e3e6ea", linewidth=0.8)
        figure.legend(loc="outside lower left", ncols=len(surfaces_m))
        return canvas.png(figure)
