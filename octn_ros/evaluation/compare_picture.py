"""One held-out B-scan as measured and as each representation has it, as PNG."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.volume import VolumeGeometry

_COLUMNS = 5


def compare_picture(title: str, images: Mapping[str, NDArray[np.float32]], geometry: VolumeGeometry) -> bytes:
    """Draw B-scans [axial, lateral] by name, to scale, five beside each other."""
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    rows = -(-len(images) // _COLUMNS)
    height = rows * (canvas.height_in(_COLUMNS, x1 - x0, z1 - z0, 0) - 0.4) + 0.4
    with canvas.figure(canvas.WIDTH_IN, height) as figure:
        figure.suptitle(title, fontsize=10)
        panels = figure.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False)
        for axes in panels.flat[len(images) :]:
            axes.set_visible(False)
        for axes, (name, image) in zip(panels.flat, images.items(), strict=False):
            axes.imshow(image, cmap="gray", extent=(x0, x1, z1, z0), vmin=0, vmax=1, interpolation="nearest")
            axes.set_title(name)
        for axes in panels[:, 0]:
            axes.set_ylabel("depth z (mm)")
        for axes in panels[-1]:
            axes.set_xlabel("lateral x (mm)")
        return canvas.png(figure)
