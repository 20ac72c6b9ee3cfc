"""The middle B-scan as it was fitted and as each field has it, a row for each variant, regions outlined, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.evaluation.bscan_picture import outline_regions
from octn_ros.metrics import RegionOfInterest
from octn_ros.volume import VolumeGeometry


def bscan_grid_picture(
    title: str,
    variants: Sequence[str],
    drawn: Mapping[tuple[str, str], NDArray[np.float32]],
    truth: NDArray[np.float32] | None,
    regions: Sequence[RegionOfInterest],
    geometry: VolumeGeometry,
) -> bytes:
    """Draw B-scans [axial, lateral] by (variant, method), beside the truth where it is known, to scale."""
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    methods = list(dict.fromkeys(method for _, method in drawn))
    columns = [*methods, *(["noise-free"] if truth is not None else [])]
    height = len(variants) * (canvas.height_in(len(columns), x1 - x0, z1 - z0, 1) - 0.6) + 0.6
    with canvas.figure(canvas.WIDTH_IN, height) as figure:
        figure.suptitle(title, fontsize=10)
        panels = figure.subplots(len(variants), len(columns), sharex=True, sharey=True, squeeze=False)
        for line, variant in zip(panels, variants, strict=True):
            for axes, column in zip(line, columns, strict=True):
                image = truth if column == "noise-free" else drawn[variant, column]
                assert image is not None  # without a truth there is no such column
                grey = axes.imshow(
                    image, cmap="gray", extent=(x0, x1, z1, z0), vmin=0, vmax=1, interpolation="nearest"
                )  # fmt: skip
                outline_regions(axes, regions, geometry)
            line[0].set_ylabel(f"{variant}\nz (mm)")
            canvas.colour_bar(figure, grey, line[-1], "intensity")
        for axes, column in zip(panels[0], columns, strict=True):
            axes.set_title(column)
        for axes in panels[-1]:
            axes.set_xlabel("x (mm)")
        return canvas.png(figure)
