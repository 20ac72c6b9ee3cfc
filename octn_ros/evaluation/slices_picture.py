"""Picture of fractional B-scans: each method's, a row for each position between the anchors, as PNG."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.volume import VolumeGeometry


def slices_picture(
    title: str,
    positions: NDArray[np.float64],
    drawn: Mapping[str, NDArray[np.float32]],
    truth: NDArray[np.float32] | None,
    geometry: VolumeGeometry,
) -> bytes:
    """Draw B-scans [position, axial, lateral] of every method, and the truth where it is known, to scale."""
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    columns = dict(drawn) if truth is None else {**drawn, "truth": truth}
    height = len(positions) * (canvas.height_in(len(columns), x1 - x0, z1 - z0, 1) - 0.6) + 0.6
    with canvas.figure(canvas.WIDTH_IN, height) as figure:
        figure.suptitle(title, fontsize=10)
        panels = figure.subplots(len(positions), len(columns), sharex=True, sharey=True, squeeze=False)
        for line, position in zip(range(len(positions)), positions, strict=True):
            for axes, (name, images) in zip(panels[line], columns.items(), strict=True):
                grey = axes.imshow(
                    images[line], cmap="gray", extent=(x0, x1, z1, z0), vmin=0, vmax=1, interpolation="nearest"
                )  # fmt: skip
                if line == 0:
                    axes.set_title(name)
            panels[line, 0].set_ylabel(f"B-scan {position:g}\nz (mm)")
            canvas.colour_bar(figure, grey, panels[line, -1], "intensity")
        for axes in panels[-1]:
            axes.set_xlabel("x (mm)")
        return canvas.png(figure)
