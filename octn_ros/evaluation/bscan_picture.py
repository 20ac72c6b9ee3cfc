"""A B-scan as measured and as a field has it, with the regions of interest, as PNG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from octn_ros.demo import canvas
from octn_ros.evaluation.fidelity import Fidelity
from octn_ros.metrics import RegionOfInterest
from octn_ros.volume import VolumeGeometry

REGION_COLOURS = {"air": "#e0524d", "tissue": "#ffffff", "boundary": "#f2b134"}


def fidelity_picture(fidelity: Fidelity, geometry: VolumeGeometry) -> bytes:
    """Draw the middle B-scan of volume and field and their difference, regions and surfaces marked, to scale."""
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    extent = (x0, x1, z1, z0)
    lateral = (geometry.origin_m[0] + np.arange(geometry.shape[2]) * geometry.spacing_m[2]) * 1e3
    regions = [entry.region for entry in fidelity.regions if entry.region is not None]
    with canvas.figure(canvas.WIDTH_IN, canvas.height_in(3, x1 - x0, z1 - z0, colour_bars=2)) as figure:
        panels = figure.subplots(1, 3, sharex=True, sharey=True)
        for axes, image, depths, title in (
            (panels[0], fidelity.measured, fidelity.grid.volume_surface, f"Measured, B-scan {fidelity.bscan}"),
            (panels[1], fidelity.rendered, fidelity.grid.field_surface, "Field"),
        ):
            grey = axes.imshow(image, cmap="gray", extent=extent, vmin=0, vmax=1, interpolation="nearest")
            surface_mm = (geometry.origin_m[2] + depths[-1, fidelity.bscan] * geometry.spacing_m[1]) * 1e3
            axes.plot(lateral, surface_mm, ".", color="#35b8c9", markersize=1.5)
            outline_regions(axes, regions, geometry)
            axes.set_title(title)
        difference = fidelity.rendered.astype(np.float64) - fidelity.measured
        limit = max(float(np.quantile(np.abs(difference), 0.995)), 1e-3)
        signed = panels[2].imshow(
            difference, cmap="RdBu_r", extent=extent, vmin=-limit, vmax=limit, interpolation="nearest"
        )
        panels[2].set_title("Field less measured")
        panels[0].set_ylabel("depth z (mm)")
        for axes in panels:
            axes.set_xlabel("lateral x (mm)")
        canvas.colour_bar(figure, grey, panels[1], "intensity")
        canvas.colour_bar(figure, signed, panels[2], "difference")
        return canvas.png(figure)


def outline_regions(axes: Axes, regions: Sequence[RegionOfInterest], geometry: VolumeGeometry) -> None:
    """Draw regions of interest with their names into a B-scan whose axes are in millimetres."""
    _, axial, lateral = (spacing * 1e3 for spacing in geometry.spacing_m)
    x, _, z = (origin * 1e3 for origin in geometry.origin_m)
    for region in regions:
        left, top = x + (region.lateral[0] - 0.5) * lateral, z + (region.axial[0] - 0.5) * axial
        width = (region.lateral[1] - region.lateral[0]) * lateral
        height = (region.axial[1] - region.axial[0]) * axial
        colour = REGION_COLOURS[region.kind]
        axes.add_patch(Rectangle((left, top), width, height, fill=False, edgecolor=colour, linewidth=1.0))
        axes.text(left, top, region.name, color=colour, fontsize=7, va="bottom")
