"""Pictures of the sparse protocol: one held-out B-scan by every method, and figures against SF, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.evaluation.benchmark import Row
from octn_ros.volume import VolumeGeometry

COLOURS = {"field": canvas.BLUE, "trilinear": "#8a9099", "cubic": "#7a4ea3", "smoothed": canvas.ORANGE}


def sparse_picture(
    title: str, measured: NDArray[np.float32], drawn: Mapping[str, NDArray[np.float32]], geometry: VolumeGeometry
) -> bytes:
    """Draw one held-out B-scan as measured and as each method has it, to scale."""
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    images = {"measured": measured, **drawn}
    with canvas.figure(canvas.WIDTH_IN, canvas.height_in(len(images), x1 - x0, z1 - z0, 1)) as figure:
        figure.suptitle(title, fontsize=10)
        panels = figure.subplots(1, len(images), sharex=True, sharey=True)
        for axes, (name, image) in zip(panels, images.items(), strict=True):
            grey = axes.imshow(
                image, cmap="gray", extent=(x0, x1, z1, z0), vmin=0, vmax=1, interpolation="nearest"
            )  # fmt: skip
            axes.set(title=name, xlabel="lateral x (mm)")
        panels[0].set_ylabel("depth z (mm)")
        canvas.colour_bar(figure, grey, panels[-1], "intensity")
        return canvas.png(figure)


def sparse_curves(rows: Sequence[Row], methods: Sequence[str]) -> bytes:
    """Draw each method's figures against SF: mean over the scans, and one standard deviation of them as a band."""
    figures = (
        ("grid_psnr_db", "PSNR, all B-scans (dB)"),
        ("psnr_db", "PSNR, held-out B-scans (dB)"),
        ("truth_psnr_db", "PSNR against the truth (dB)"),
        ("chamfer_um", "Chamfer (um)"),
    )
    shown = tuple((key, title) for key, title in figures if any(_finite(row, f"field_{key}") for row in rows))
    with canvas.figure(canvas.WIDTH_IN, 3.2) as figure:
        panels = np.atleast_1d(figure.subplots(1, len(shown)))
        for axes, (key, title) in zip(panels, shown, strict=True):
            for method in methods:
                name = f"{method}_{key}"
                factors = sorted({row["sf"] for row in rows if _finite(row, name)})
                values = [[row[name] for row in rows if row["sf"] == sf and _finite(row, name)] for sf in factors]
                mean, deviation = (np.array([statistic(each) for each in values]) for statistic in (np.mean, np.std))
                axes.plot(factors, mean, ".-", color=COLOURS[method], label=method)
                axes.fill_between(factors, mean - deviation, mean + deviation, color=COLOURS[method], alpha=0.12)
            axes.set_xscale("log", base=2)
            factors = sorted({row["sf"] for row in rows})
            axes.set_xticks(factors, [str(factor) for factor in factors])
            axes.set(title=title, xlabel="SF")
        panels[0].legend()
        return canvas.png(figure)


def _finite(row: Row, key: str) -> bool:
    return key in row and bool(np.isfinite(row[key]))
