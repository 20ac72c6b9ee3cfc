"""The pictures of the report, as PNG bytes.

Every picture is drawn on a Figure of its own with the Agg canvas: no pyplot, no display, no global state. Lengths are
drawn to scale, in millimetres of the OCT frame; depth is the optical path from the first axial voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.demo.canvas import BLUE, DEPTH_COLOURS, INK, ORANGE, RED
from octn_ros.volume.geometry import VolumeGeometry


@dataclass(frozen=True)
class PathPicture:
    """The laser path as the pictures need it.

    Attributes:
        points_mm: focus positions in the OCT frame, [N, 3] as (lateral, bscan, depth), millimetres.
        segment: number of the raster segment of each point, [N].
    """

    points_mm: NDArray[np.float64]
    segment: NDArray[np.int32]

    def lines(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pieces between neighbours of one segment, [M, 2, 3] mm, and their mean depths [M] mm."""
        same = self.segment[1:] == self.segment[:-1]
        pieces = np.stack([self.points_mm[:-1][same], self.points_mm[1:][same]], axis=1)
        return pieces, pieces[:, :, 2].mean(axis=1)


@dataclass(frozen=True)
class FitPoint:
    """One line of the fit's progress: seconds since its start, loss (MSE), PSNR (dB) and stage."""

    seconds: float
    loss: float
    psnr_db: float
    stage: str


def enface_picture(enface: NDArray[np.floating], geometry: VolumeGeometry, path: PathPicture) -> bytes:
    """Draw the view from above with its grey levels stretched, bare and with the raster coloured by depth.

    Args:
        enface: intensity [bscan, lateral], 0 to 1.
        geometry: of the volume it was taken from.
        path: the waypoints.
    """
    x0, x1, y0, y1, _, _ = canvas.edges_mm(geometry)
    with canvas.figure(canvas.WIDTH_IN, canvas.height_in(2, (x1 - x0), (y1 - y0), colour_bars=1)) as figure:
        bare, planned = figure.subplots(1, 2, sharex=True, sharey=True)
        black, white = np.quantile(enface, (0.005, 0.998))
        for axes in (bare, planned):
            axes.imshow(enface, cmap="gray", extent=(x0, x1, y1, y0), interpolation="nearest", vmin=black, vmax=white)
            axes.set_xlabel("lateral x (mm)")
        bare.set_ylabel("bscan y (mm)")
        bare.set_title("En face, maximum along depth")
        pieces, depth = path.lines()
        lines = LineCollection(list(pieces[:, :, :2]), cmap=DEPTH_COLOURS, linewidths=1.3)
        lines.set_array(depth)
        planned.add_collection(lines)
        if len(path.points_mm):
            for point, marker, label in ((path.points_mm[0], "o", "start"), (path.points_mm[-1], "s", "end")):
                planned.plot(*point[:2], marker, color=RED, markersize=5, markeredgecolor="white", label=label)
            planned.legend(
                loc="upper right", ncols=2, frameon=True, facecolor="white", edgecolor="none", framealpha=0.85
            )
        planned.set_title(f"Raster, {len(path.points_mm)} waypoints")
        canvas.colour_bar(figure, lines, planned, "depth z (mm)")
        return canvas.png(figure)


def bscan_picture(
    measured: NDArray[np.floating],
    fitted: NDArray[np.floating],
    geometry: VolumeGeometry,
    index: int,
    path: PathPicture,
    surface_mm: NDArray[np.float64] | None = None,
) -> bytes:
    """Draw one B-scan as measured, as the field has it, and their difference, with surface and waypoints.

    Args:
        measured: intensity [axial, lateral], 0 to 1.
        fitted: the field at the same voxels.
        geometry: of the volume.
        index: number of the B-scan.
        path: the waypoints; those within half a B-scan (or half a raster line) of this one are drawn.
        surface_mm: the true depth at each lateral voxel [lateral], NaN where unknown, or None.
    """
    x0, x1, _, _, z0, z1 = canvas.edges_mm(geometry)
    y = (geometry.origin_m[1] + index * geometry.spacing_m[0]) * 1e3
    near = path.points_mm[_on_bscan(path, y, geometry.spacing_m[0] * 1e3)]
    lateral = (geometry.origin_m[0] + np.arange(geometry.shape[2]) * geometry.spacing_m[2]) * 1e3
    with canvas.figure(
        canvas.WIDTH_IN, canvas.height_in(3, (x1 - x0), (z1 - z0), colour_bars=2, legend_in=0.3)
    ) as figure:
        panels = figure.subplots(1, 3, sharex=True, sharey=True)
        extent = (x0, x1, z1, z0)
        grey = panels[0].imshow(measured, cmap="gray", extent=extent, vmin=0, vmax=1, interpolation="nearest")
        panels[1].imshow(fitted, cmap="gray", extent=extent, vmin=0, vmax=1, interpolation="nearest")
        difference = np.asarray(fitted, dtype=np.float64) - measured
        limit = max(float(np.quantile(np.abs(difference), 0.995)), 1e-3)
        signed = panels[2].imshow(
            difference, cmap="RdBu_r", extent=extent, vmin=-limit, vmax=limit, interpolation="nearest"
        )
        for axes, title in zip(
            panels, (f"B-scan {index}, measured", "Field at the same voxels", "Field minus measured"), strict=True
        ):
            axes.set_title(title)
            axes.set_xlabel("lateral x (mm)")
            if len(near):
                axes.plot(near[:, 0], near[:, 2], ".", color="#12b5a6", markersize=4.0, label="waypoints of the plan")
            if surface_mm is not None:
                axes.plot(lateral, surface_mm, color="#e8541e", linewidth=0.8, label="true surface of the phantom")
            axes.set_xlim(x0, x1)
            axes.set_ylim(z1, z0)
        panels[0].set_ylabel("depth z (mm)")
        _legend_below(figure, panels[0])
        canvas.colour_bar(figure, grey, panels[1], "intensity (0 to 1)")
        canvas.colour_bar(figure, signed, panels[2], "difference of intensity")
        return canvas.png(figure)


def fit_picture(history: Sequence[FitPoint]) -> bytes:
    """Draw PSNR and loss against time, with the two stages of Algorithm 1 marked."""
    with canvas.figure(canvas.WIDTH_IN, 3.6) as figure:
        axes = figure.subplots()
        loss_axes = axes.twinx()
        seconds = [point.seconds for point in history]
        axes.set_xlabel("time since the start of the fit (s)")
        axes.set_ylabel("PSNR (dB)", color=BLUE)
        loss_axes.set_ylabel("loss (mean squared error)", color=ORANGE)
        loss_axes.set_yscale("log")
        axes.plot(seconds, [point.psnr_db for point in history], color=BLUE, linewidth=1.8)
        loss_axes.plot(seconds, [max(point.loss, 1e-12) for point in history], color=ORANGE, linewidth=1.1, alpha=0.9)
        loss_axes.grid(False)
        axes.grid(color="#e3e6ea", linewidth=0.8)
        shades = ("#eef3fa", "#faf3ea")
        for number, (stage, begin, end) in enumerate(_stages(history)):
            axes.axvspan(begin, end, color=shades[number % 2], zorder=0)
            # Above the axes, where no curve runs through the words.
            axes.text(
                (begin + end) / 2, 1.015, f"{stage} stage", transform=axes.get_xaxis_transform(), ha="center",
                va="bottom", fontsize=8.5, color="#555b63",
            )  # fmt: skip
        if history:
            axes.set_xlim(0, max(seconds[-1], 1e-3))
        return canvas.png(figure)


def surface_picture(
    depth_mm: NDArray[np.floating],
    lateral_mm: NDArray[np.floating],
    bscan_mm: NDArray[np.floating],
    path: PathPicture,
) -> bytes:
    """Draw the surface of the field (eq. 3) in three dimensions, to scale, with the laser path over it.

    The surface is left out where it lies far above or below the path: it is not the one that the path is on.

    Args:
        depth_mm: surface depth [bscan, lateral], NaN where there is none.
        lateral_mm: x of the columns [lateral].
        bscan_mm: y of the rows [bscan].
        path: the waypoints.
    """
    with canvas.figure(canvas.WIDTH_IN, 5.2) as figure:
        axes = figure.add_subplot(projection="3d", computed_zorder=False)
        x, y = np.meshgrid(lateral_mm, bscan_mm)
        low, high = _depth_limits(depth_mm, path)
        shown = np.where((depth_mm >= low) & (depth_mm <= high), depth_mm, np.nan)
        surface = axes.plot_surface(
            x, y, shown, color="#d9dde3", edgecolor="none", alpha=0.95, rcount=80, ccount=80, zorder=1
        )
        surface.set_clip_on(False)  # the box reaches beyond the square that 3D axes are given
        pieces, depth = path.lines()
        if len(pieces):
            lines = Line3DCollection(list(pieces), cmap=DEPTH_COLOURS, linewidths=1.0, zorder=2)
            lines.set_array(depth)
            lines.set_clip_on(False)
            axes.add_collection3d(lines, autolim=False)
            figure.colorbar(lines, ax=axes, label="depth z (mm)", shrink=0.6, pad=0.09)
        axes.set_xlim(lateral_mm[0], lateral_mm[-1])
        axes.set_ylim(bscan_mm[0], bscan_mm[-1])
        axes.set_zlim(high, low)  # depth grows into the tissue, away from the probe above
        sides = np.array([np.ptp(lateral_mm), np.ptp(bscan_mm), high - low])
        # A flat box leaves room above and below; a tall one needs it.
        axes.set_box_aspect(sides, zoom=float(np.clip(1.4 - 0.6 * sides[2] / sides[:2].max(), 0.8, 1.25)))
        axes.set_xlabel("lateral x (mm)")
        axes.set_ylabel("bscan y (mm)")
        axes.set_zlabel("depth z (mm)")
        axes.locator_params(axis="z", nbins=4)
        axes.view_init(elev=32, azim=-58)
        return canvas.png(figure)


def error_picture(points_mm: NDArray[np.floating], error_um: NDArray[np.floating]) -> bytes:
    """Draw how far each waypoint lies below (+) or above (-) the phantom's true surface.

    Args:
        points_mm: lateral and bscan position [N, 2 or more], millimetres.
        error_um: depth minus true depth [N], micrometres.
    """
    width, height = np.ptp(points_mm[:, :2], axis=0) if len(points_mm) else (1.0, 1.0)
    with canvas.figure(canvas.WIDTH_IN, canvas.height_in(2, width, height, colour_bars=1)) as figure:
        over, counts = figure.subplots(1, 2)
        limit = max(float(np.quantile(np.abs(error_um), 0.99)), 1e-3) if len(error_um) else 1.0
        dots = over.scatter(
            points_mm[:, 0], points_mm[:, 1], c=error_um, cmap="RdBu_r", vmin=-limit, vmax=limit, s=7, marker="s"
        )
        over.set_aspect("equal")
        over.invert_yaxis()
        over.set_xlabel("lateral x (mm)")
        over.set_ylabel("bscan y (mm)")
        over.set_title("Waypoint depth minus true depth")
        canvas.colour_bar(figure, dots, over, "depth error (um)")
        counts.hist(np.clip(error_um, -2 * limit, 2 * limit), bins=60, color=BLUE)
        counts.axvline(0, color=INK, linewidth=0.8)
        counts.set_xlabel("depth error (um)")
        counts.set_ylabel("waypoints")
        counts.set_title("Its distribution")
        counts.spines[["top", "right"]].set_visible(False)
        counts.set_box_aspect(height / width if height and width else 1.0)
        return canvas.png(figure)


def _on_bscan(path: PathPicture, y_mm: float, spacing_mm: float) -> NDArray[np.bool_]:
    if not len(path.points_mm):
        return np.zeros(0, dtype=bool)
    # A line may lie exactly half-way between two B-scans, give or take the last digit.
    return np.asarray(np.abs(path.points_mm[:, 1] - y_mm) <= 0.501 * spacing_mm)


def _legend_below(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower left", ncols=len(handles), markerscale=3)


def _stages(history: Sequence[FitPoint]) -> list[tuple[str, float, float]]:
    """Return (name, first second, last second) of each run of equal stages; each reaches to the next one's start."""
    stages: list[tuple[str, float, float]] = []
    for point in history:
        if stages and stages[-1][0] == point.stage:
            stages[-1] = (point.stage, stages[-1][1], point.seconds)
        else:
            begin = stages[-1][2] if stages else 0.0
            stages.append((point.stage, begin, point.seconds))
    return stages


def _depth_limits(depth_mm: NDArray[np.floating], path: PathPicture) -> tuple[float, float]:
    """Depth range of the path and its surroundings; without a path, of all but the stray hundredth of the surface."""
    depths = path.points_mm[:, 2]
    if not len(depths):
        depths = depth_mm[np.isfinite(depth_mm)]
    low, high = np.quantile(depths, (0.005, 0.995)) if len(depths) else (0.0, 1.0)
    margin = 0.5 * (high - low) + 0.05
    return float(low - margin), float(high + margin)
