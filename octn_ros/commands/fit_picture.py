"""The picture of a fit: a B-scan as measured and as fitted, and how the PSNR came about."""

from __future__ import annotations

from collections.abc import Sequence

from octn_ros.demo import canvas
from octn_ros.demo.canvas import BLUE, ORANGE
from octn_ros.field import NeuralField
from octn_ros.query import bscan_slice
from octn_ros.training import FitProgress
from octn_ros.volume import Volume


def fit_picture(volume: Volume, field: NeuralField, history: Sequence[FitProgress]) -> bytes:
    """Draw the middle B-scan of the volume beside the field's, to scale, and below them PSNR and loss against steps.

    Args:
        volume: what was measured.
        field: what was fitted to it.
        history: the reports of the fit.

    Returns:
        A PNG.
    """
    index = volume.geometry.shape[0] // 2
    fitted = bscan_slice(field, index)
    x0, x1, _, _, z0, z1 = canvas.edges_mm(volume.geometry)
    above = canvas.height_in(2, x1 - x0, z1 - z0, colour_bars=1)
    with canvas.figure(canvas.WIDTH_IN, above + 3.0) as figure:
        rows = figure.add_gridspec(2, 1, height_ratios=(above, 3.0))
        pair = rows[0].subgridspec(1, 2)
        images = [figure.add_subplot(pair[0]), figure.add_subplot(pair[1])]
        for axes, image, title in zip(
            images, (volume.normalized(index), fitted), (f"B-scan {index}, measured", "fitted"), strict=True
        ):
            drawn = axes.imshow(image, cmap="gray", extent=(x0, x1, z1, z0), vmin=0, vmax=1, interpolation="nearest")
            axes.set_title(title)
            axes.set_xlabel("lateral x (mm)")
        images[0].set_ylabel("depth z (mm)")
        canvas.colour_bar(figure, drawn, images[1], "intensity (0 to 1)")
        curve = figure.add_subplot(rows[1])
        steps = [report.step for report in history]
        curve.plot(steps, [report.psnr_db for report in history], color=BLUE, linewidth=1.8)
        curve.set_xlabel("step")
        curve.set_ylabel("PSNR on held-in voxels (dB)", color=BLUE)
        curve.grid(color="#e3e6ea", linewidth=0.8)
        loss = curve.twinx()
        loss.plot(steps, [max(report.loss, 1e-12) for report in history], color=ORANGE, linewidth=1.1)
        loss.set_ylabel("loss", color=ORANGE)
        loss.set_yscale("log")
        discrete = [report.step for report in history if report.stage == "discrete"]
        if discrete and discrete[0] != steps[0]:
            curve.axvline(discrete[0], color="#8a9099", linewidth=0.8, linestyle="--")
            curve.set_title("PSNR and loss; the dashed line is where the discrete stage begins")
        else:
            curve.set_title("PSNR and loss")
        return canvas.png(figure)
