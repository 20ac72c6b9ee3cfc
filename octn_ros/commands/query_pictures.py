"""The pictures of `octn slice`, `octn surface` and `octn band`, as PNG bytes, to scale in millimetres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.query import BandPoints, SliceImage, SurfaceMap

_AXIS_NAMES = ("lateral x", "bscan y", "depth z")
# A band of more points than this is drawn as a sample of them.
_MOST_DOTS = 200_000


def slice_picture(image: SliceImage) -> bytes:
    """Draw a slice with its axes in millimetres of the OCT frame, in grey; depth in colours, finite cells only."""
    rows, columns = image.pixels.shape
    along, down = np.array(image.along_m) * 1e3, np.array(image.down_m) * 1e3
    across, names = [], []
    for direction, count in ((along, columns), (down, rows)):
        step = float(np.linalg.norm(direction))
        axis = int(np.argmax(np.abs(direction)))
        # Along an axis of the frame the frame's own coordinate is shown, otherwise the way from the first cell on.
        straight = bool(direction[axis] > 0.999 * step)
        first = image.origin_m[axis] * 1e3 if straight else 0.0
        across.append((first - step / 2, first + (count - 0.5) * step))
        names.append(_AXIS_NAMES[axis] if straight else "way along the plane")
    (left, right), (top, bottom) = across
    height = canvas.height_in(1, right - left, bottom - top, colour_bars=1)
    with canvas.figure(canvas.WIDTH_IN, height) as figure:
        axes = figure.subplots()
        depth = image.quantity == "depth_m"
        shown = axes.imshow(
            image.pixels * 1e3 if depth else image.pixels,
            cmap=canvas.DEPTH_COLOURS if depth else "gray",
            vmin=None if depth else 0.0,
            vmax=None if depth else 1.0,
            extent=(left, right, bottom, top),
            interpolation="nearest",
        )
        axes.set_title(image.specification)
        axes.set_xlabel(f"{names[0]} (mm)")
        axes.set_ylabel(f"{names[1]} (mm)")
        words = {"depth_m": "depth z (mm)", "intensity": "intensity (0 to 1)", "light": "light (0 to 1)"}
        canvas.colour_bar(figure, shown, axes, words[image.quantity])
        return canvas.png(figure)


def surface_picture(surface: SurfaceMap) -> bytes:
    """Draw depth and confidence of a surface map side by side, seen along the beam."""
    x, y = surface.lateral_m * 1e3, surface.bscan_m * 1e3
    dx, dy = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    extent = (x[0] - dx, x[-1] + dx, y[-1] + dy, y[0] - dy)
    height = canvas.height_in(2, np.ptp(x) + 2 * dx, np.ptp(y) + 2 * dy, colour_bars=2)
    with canvas.figure(canvas.WIDTH_IN, height) as figure:
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        depth = surface.depth_m * 1e3
        low, high = np.quantile(depth, (0.01, 0.99))
        shown = left.imshow(depth, cmap=canvas.DEPTH_COLOURS, vmin=low, vmax=max(high, low + 1e-3), extent=extent)
        sure = right.imshow(surface.confidence, cmap="gray", vmin=0.0, vmax=1.0, extent=extent)
        left.set_title("Depth of the surface")
        right.set_title("Confidence")
        left.set_ylabel("bscan y (mm)")
        for axes in (left, right):
            axes.set_xlabel("lateral x (mm)")
        canvas.colour_bar(figure, shown, left, "depth z (mm)")
        canvas.colour_bar(figure, sure, right, "confidence (0 to 1)")
        return canvas.png(figure)


def band_picture(found: BandPoints) -> bytes:
    """Draw the points of a band from above and from the side, the brightest on top."""
    points, intensity = _drawn(found)
    x0, x1, y0, y1, z0, z1 = canvas.edges_mm(found.description.geometry)
    height = canvas.height_in(2, x1 - x0, max(y1 - y0, z1 - z0), colour_bars=1)
    with canvas.figure(canvas.WIDTH_IN, height) as figure:
        above, side = figure.subplots(1, 2)
        for axes, axis, limits in ((above, 1, (y1, y0)), (side, 2, (z1, z0))):
            dots = axes.scatter(
                points[:, 0], points[:, axis], c=intensity, s=1.0, cmap="viridis", linewidths=0,
                vmin=found.query.low, vmax=found.query.high,
            )  # fmt: skip
            axes.set_aspect("equal")
            axes.set_xlim(x0, x1)
            axes.set_ylim(*limits)
            axes.set_xlabel("lateral x (mm)")
            axes.set_ylabel(f"{_AXIS_NAMES[axis]} (mm)")
        above.set_title(f"{len(found.points_m):,} points, {found.query.low:g} to {found.query.high:g}")
        side.set_title("From the side")
        canvas.colour_bar(figure, dots, side, "intensity (0 to 1)")
        return canvas.png(figure)


def _drawn(found: BandPoints) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    every = max(1, -(-len(found.points_m) // _MOST_DOTS))
    points, intensity = found.points_m[::every] * 1e3, found.intensity[::every]
    order = np.argsort(intensity, kind="stable")
    return points[order], intensity[order]
