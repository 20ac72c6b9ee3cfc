"""The picture of a plan: where it runs on the en-face view, how deep, and how close it comes to tau."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from octn_ros.demo import canvas
from octn_ros.demo.canvas import BLUE, DEPTH_COLOURS, INK, RED

if TYPE_CHECKING:
    from octn_ros.field import Field
    from octn_ros.planning import Plan

_SIDE, _DEPTHS = 200, 256  # of the lattice that the en-face view is taken from


def plan_picture(field: Field, plan: Plan) -> bytes:
    """Draw the largest intensity along depth with the path coloured by depth, and the residuals; return a PNG.

    Args:
        field: what was planned on.
        plan: the plan; lead-ins and lead-outs are drawn in white, given-up places as red dots.
    """
    x0, x1, y0, y1, _, _ = canvas.edges_mm(field.geometry)
    with canvas.figure(canvas.WIDTH_IN, canvas.height_in(2, (x1 - x0), (y1 - y0), colour_bars=1)) as figure:
        above, histogram = figure.subplots(1, 2)
        enface = _enface(field)
        black, white = np.quantile(enface, (0.005, 0.998))
        above.imshow(enface, cmap="gray", extent=(x0, x1, y1, y0), interpolation="nearest", vmin=black, vmax=white)
        place = plan.surface_m * 1e3
        joined = np.diff(plan.segment) == 0
        fired = joined & plan.laser_on[1:] & plan.laser_on[:-1]
        pieces = np.stack([place[:-1], place[1:]], axis=1)
        above.add_collection(LineCollection(list(pieces[joined & ~fired][:, :, :2]), colors="white", linewidths=0.8))
        lines = LineCollection(list(pieces[fired][:, :, :2]), cmap=DEPTH_COLOURS, linewidths=1.3)
        lines.set_array(pieces[fired][:, :, 2].mean(axis=1))
        above.add_collection(lines)
        if plan.given_up_points:
            lost = np.array([(point.x_m, point.y_m) for point in plan.given_up_points]) * 1e3
            above.plot(*lost.T, ".", color=RED, markersize=2)
        above.set_xlabel("lateral x (mm)")
        above.set_ylabel("bscan y (mm)")
        above.set_title(f"{int(plan.laser_on.sum())} waypoints, {plan.given_up} given up (red)")
        canvas.colour_bar(figure, lines, above, "depth z (mm)")
        residual = 100.0 * plan.residual[plan.laser_on] / plan.tau
        reach = max(float(np.abs(residual).max()), 1e-3)
        histogram.hist(residual, bins=np.linspace(-reach, reach, 41), color=BLUE)
        histogram.set_yscale("log")
        histogram.axvline(0.0, color=INK, linewidth=0.8)
        histogram.set_xlabel("residual (f - tau) / tau (%)")
        histogram.set_ylabel("waypoints")
        histogram.set_title(f"Hit rate {100 * plan.hit_rate:.1f} % at tau = {plan.tau:.3f}")
        return canvas.png(figure)


def _enface(field: Field) -> NDArray[np.float32]:
    bscans, axials, laterals = field.geometry.shape
    axes = (min(laterals, _SIDE), min(axials, _DEPTHS), min(bscans, _SIDE))
    lateral, axial, bscan = (torch.linspace(-1.0, 1.0, count, device=field.device) for count in axes)
    return np.asarray(field.lattice(lateral, axial, bscan).amax(dim=1).cpu().numpy())
