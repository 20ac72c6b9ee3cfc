"""Pictures of the share of interpolated samples: PSNR against alpha beside the paper's, and a fractional B-scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.evaluation.benchmark import Row
from octn_ros.volume import VolumeGeometry


def alpha_curves(rows: Sequence[Row], paper: Sequence[Row]) -> bytes:
    """Draw PSNR against alpha on the volume and on the fractional B-scan: mean and one standard deviation."""
    with canvas.figure(canvas.WIDTH_IN, 3.2) as figure:
        panels = figure.subplots(1, 2, sharex=True)
        for axes, part, title in zip(panels, ("volume", "slice"), ("All voxels", "B-scan D/2 + 0.5"), strict=True):
            for lines, colour, name in ((rows, canvas.BLUE, "measured here"), (paper, canvas.ORANGE, "paper, table 4")):
                alpha, mean = ([row[key] for row in lines] for key in ("alpha", f"{part}_psnr_db"))
                deviation = [row.get(f"{part}_psnr_sd_db", 0.0) for row in lines]  # a single scan has none
                axes.errorbar(alpha, mean, deviation, fmt=".-", color=colour, capsize=2.5, linewidth=1.2, label=name)
            axes.set(title=title, xlabel="alpha", ylabel="PSNR (dB)")
        panels[0].legend()
        return canvas.png(figure)


def alpha_slices(
    title: str, proxy: NDArray[np.float32], drawn: Mapping[float, NDArray[np.float32]], geometry: VolumeGeometry
) -> bytes:
    """Draw a fractional B-scan by trilinear interpolation, and from the field at each alpha, to scale."""
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    images = {"trilinear": proxy, **{f"alpha {alpha:g}": image for alpha, image in drawn.items()}}
    with canvas.figure(canvas.WIDTH_IN, canvas.height_in(len(images), x1 - x0, z1 - z0, 1)) as figure:
        figure.suptitle(title, fontsize=10)
        panels = np.atleast_1d(figure.subplots(1, len(images), sharex=True, sharey=True))
        for axes, (name, image) in zip(panels, images.items(), strict=True):
            grey = axes.imshow(
                image, cmap="gray", extent=(x0, x1, z1, z0), vmin=0, vmax=1, interpolation="nearest"
            )  # fmt: skip
            axes.set(title=name, xlabel="x (mm)")
        panels[0].set_ylabel("depth z (mm)")
        canvas.colour_bar(figure, grey, panels[-1], "intensity")
        return canvas.png(figure)
