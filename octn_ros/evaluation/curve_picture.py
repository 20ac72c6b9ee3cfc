"""Pictures in the manner of the paper's figure 7: curves of the fits, box plots of their final quality, as PNG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from octn_ros.demo import canvas
from octn_ros.evaluation.benchmark import Row

_COLOURS = (canvas.BLUE, canvas.ORANGE, "#7a4ea3", "#8a9099")
_FIGURES = (("psnr_db", "PSNR (dB)"), ("ssim", "SSIM"))


def training_curves(rows: Sequence[Row]) -> bytes:
    """Draw loss and PSNR of every fit against seconds; a dot and a dashed line where the hybrid stage ends."""
    starts = list(dict.fromkeys(row["start"] for row in rows))
    with canvas.figure(canvas.WIDTH_IN, 3.4) as figure:
        panels = figure.subplots(1, 2, sharex=True)
        for axes, key, title in zip(panels, ("curve_loss", "curve_db"), ("Loss", "PSNR, 16 B-scans (dB)"), strict=True):
            for number, start in enumerate(starts):
                colour = _COLOURS[number % len(_COLOURS)]
                mine = [row for row in rows if row["start"] == start and row["curve_s"]]
                axes.plot([], [], color=colour, linewidth=0.9, label=start)  # also of fits that ended before a report
                for row in mine:
                    axes.plot(row["curve_s"], row[key], color=colour, linewidth=0.9, alpha=0.8)
                    hybrid = row["curve_stage"].count("hybrid")
                    if 0 < hybrid < len(row["curve_s"]):
                        axes.plot(row["curve_s"][hybrid], row[key][hybrid], ".", color=colour, markersize=6)
                switches = [row["switch_s"] for row in mine if row.get("switch_s") is not None]
                if switches:
                    axes.axvline(float(np.mean(switches)), color=colour, linestyle="--", linewidth=0.8)
            axes.set(title=title, xlabel="seconds")
            axes.set_xlim(left=0.0)
        if any(row["curve_s"] for row in rows):  # an axis without anything on it has no logarithms
            panels[0].set_yscale("log")
        panels[1].axhline(30.0, color="#8a9099", linewidth=0.8, linestyle=":")
        panels[1].text(0.99, 30.0, "30 dB", transform=panels[1].get_yaxis_transform(), ha="right", va="bottom")
        panels[0].legend(title="left of the dashes hybrid, right of them discrete", title_fontsize=8)
        return canvas.png(figure)


def distribution_boxes(rows: Sequence[Row]) -> bytes:
    """Draw final PSNR and SSIM of the raw scans, a box for each group (fig. 7b)."""
    groups = list(dict.fromkeys(row["group"] for row in rows))
    with canvas.figure(canvas.WIDTH_IN, 3.2) as figure:
        for axes, (key, title) in zip(figure.subplots(1, 2), _FIGURES, strict=True):
            values = [_values(rows, group, "raw", key) for group in groups]
            _boxes(axes, values, list(range(1, len(groups) + 1)), canvas.BLUE)
            axes.set_xticks(range(1, len(groups) + 1), groups)
            axes.set_title(title)
        return canvas.png(figure)


def noise_reduction_boxes(rows: Sequence[Row]) -> bytes:
    """Draw final PSNR and SSIM with and without noise reduction before the fit, side by side per group (fig. 7c)."""
    groups = list(dict.fromkeys(row["group"] for row in rows))
    ways = list(dict.fromkeys(row["noise_reduction"] for row in rows))
    with canvas.figure(canvas.WIDTH_IN, 3.2) as figure:
        panels = figure.subplots(1, 2)
        for axes, (key, title) in zip(panels, _FIGURES, strict=True):
            for number, way in enumerate(ways):
                places = [group * (len(ways) + 1) + number for group in range(len(groups))]
                colour = _COLOURS[number % len(_COLOURS)]
                _boxes(axes, [_values(rows, group, way, key) for group in groups], places, colour)
                axes.plot([], [], color=colour, label=way)
            axes.set_xticks([group * (len(ways) + 1) + (len(ways) - 1) / 2 for group in range(len(groups))], groups)
            axes.set_title(title)
        panels[0].legend()
        return canvas.png(figure)


def _boxes(axes: Axes, values: Sequence[Sequence[float]], places: Sequence[float], colour: str) -> None:
    """Draw boxes from quartile to quartile, and every single value, which tells how many a box stands for."""
    style = {"color": colour}
    axes.boxplot(
        [list(each) for each in values], positions=list(places), widths=0.6, boxprops=style, whiskerprops=style,
        capprops=style, medianprops=style, showfliers=False, manage_ticks=False,
    )  # fmt: skip
    for place, each in zip(places, values, strict=True):
        axes.plot([place] * len(each), each, ".", color=colour, markersize=4)


def _values(rows: Sequence[Row], group: str, way: str, key: str) -> list[float]:
    mine = (row[key] for row in rows if row["group"] == group and row["noise_reduction"] == way)
    return [value for value in mine if value == value]
