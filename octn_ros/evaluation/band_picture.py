"""The picture of the band queries in the manner of fig. 3: the bands in a B-scan, and bars of seconds, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import ListedColormap
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.evaluation.benchmark import Row
from octn_ros.query import PAPER_BANDS
from octn_ros.volume import VolumeGeometry

# Outside every band, then the paper's three.
_BANDS = ListedColormap(["#14171b", canvas.BLUE, canvas.ORANGE, "#f5e663"])
_STAGES = {
    "initialisation_s": "#8a9099",
    "filtering_s": canvas.BLUE,
    "masking_s": canvas.ORANGE,
    "transfer_s": canvas.RED,
}


def band_picture(
    title: str, bscans: Mapping[str, NDArray[np.float32]], geometry: VolumeGeometry, rows: Sequence[Row]
) -> bytes:
    """Draw one scan's table.

    Args:
        title: above it.
        bscans: intensities [axial, lateral] of one B-scan by what they are of.
        geometry: of the scan.
        rows: of the scan, all bands and ways.
    """
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    ways = list(dict.fromkeys(row["way"] for row in rows))
    bands = list(dict.fromkeys(row["band"] for row in rows))
    above = canvas.height_in(len(bscans), x1 - x0, z1 - z0, 0)
    with canvas.figure(canvas.WIDTH_IN, above + 0.35 * len(ways) * len(bands) + 1.0) as figure:
        figure.suptitle(title, fontsize=10)
        halves = figure.add_gridspec(2, 1, height_ratios=[above, 0.35 * len(ways) * len(bands) + 1.0])
        upper, lower = (figure.add_subfigure(halves[row]) for row in range(2))
        panels = np.atleast_1d(upper.subplots(1, len(bscans), sharex=True, sharey=True))
        for axes, (name, image) in zip(panels, bscans.items(), strict=True):
            number = sum((index + 1) * query.contains(image) for index, query in enumerate(PAPER_BANDS))
            axes.imshow(number, cmap=_BANDS, vmin=-0.5, vmax=3.5, extent=(x0, x1, z1, z0), interpolation="nearest")
            axes.set(title=name, xlabel="lateral x (mm)")
        panels[0].set_ylabel("depth z (mm)")
        total, query_only = lower.subplots(1, 2, sharey=True)
        names = [f"{row['band']} {row['way']}" for row in rows]
        left = np.zeros(len(rows))
        for stage, colour in _STAGES.items():
            seconds = np.array([row.get(stage) or 0.0 for row in rows])
            if seconds.any():
                total.barh(names, seconds, left=left, color=colour, label=stage.removesuffix("_s"))
            left += seconds
        total.set(title="from the file to the points", xlabel="s")
        total.legend()
        query_only.barh(names, [row["query_s"] for row in rows], color=canvas.BLUE)
        query_only.set(title="query alone", xlabel="s", xscale="log")
        total.invert_yaxis()
        return canvas.png(figure)
