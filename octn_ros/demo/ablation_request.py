"""What is to be ablated, and how much of it the next pass shall take, from what the passes before took."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo.rectangle import Corner
from octn_ros.errors import ConfigurationError
from octn_ros.query import SurfaceMap
from octn_ros.simulation import LaserConfig

_LEARNING_DEPTH_M = 20e-6  # what less took away says little of the laser: the scans are not that exact


@dataclass(frozen=True)
class AblationRequest:
    """A depth over a rectangle, and what is known of the laser beforehand; immutable.

    Attributes:
        depth_m: how much shall be gone, along the beam.
        corners_m: opposite corners (x, y) of the rectangle in the OCT frame, sides along its axes.
        laser: the laser as it is taken to be. Its heat of ablation is a guess, which the first pass corrects.
        spacing_m: between the lines, and between the shots of a line.
        largest_pass_m: no pass takes more than this away.
        tolerance_m: the loop ends this near to the depth.
        most_passes: and after so many passes in any case.

    Raises:
        ConfigurationError: the rectangle is none, or a depth is not positive.
    """

    depth_m: float
    corners_m: tuple[Corner, Corner]
    laser: LaserConfig = field(default_factory=LaserConfig)
    spacing_m: float = 75e-6
    largest_pass_m: float = 100e-6
    tolerance_m: float = 8e-6
    most_passes: int = 8

    def __post_init__(self) -> None:
        if not (math.isfinite(self.depth_m) and self.depth_m > 0.0):
            raise ConfigurationError(f"expected a depth above 0 um to ablate, got {self.depth_m * 1e6:g} um")
        (x0, y0), (x1, y1) = self.corners_m
        narrowest = 2.0 * self.laser.spot_radius_m
        if not (x1 - x0 > narrowest and y1 - y0 > narrowest):
            raise ConfigurationError(
                f"expected a rectangle wider than two spot radii ({narrowest * 1e6:.0f} um), got "
                f"{(x1 - x0) * 1e6:.0f} x {(y1 - y0) * 1e6:.0f} um"
            )

    def inside(self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], band_m: float) -> NDArray[np.bool_]:
        """Return which places [y, x] of a lattice lie in the rectangle, at least `band_m` from its edges.

        A negative band widens the rectangle.
        """
        (x0, y0), (x1, y1) = self.corners_m
        columns = (x_m >= x0 + band_m) & (x_m <= x1 - band_m)
        rows = (y_m >= y0 + band_m) & (y_m <= y1 - band_m)
        return np.asarray(rows[:, None] & columns[None, :])

    def measured_depths_m(self, before: SurfaceMap, after: SurfaceMap) -> NDArray[np.float64]:
        """Return how much deeper the surface of a field lies [P], in the rectangle less a band of one spot radius."""
        inside = self.inside(before.lateral_m, before.bscan_m, self.laser.spot_radius_m)
        return np.asarray((after.depth_m - before.depth_m)[inside], dtype=np.float64)

    def measured_depth_m(self, before: SurfaceMap, after: SurfaceMap) -> float:
        """Return the median of `measured_depths_m`."""
        return float(np.median(self.measured_depths_m(before, after)))


@dataclass(frozen=True)
class Planning:
    """What the next pass shall take away, and the length of its bursts that should do it."""

    depth_m: float
    dwell_s: float


@dataclass(frozen=True)
class PassReport:
    """One pass that was fired.

    Attributes:
        planning: what it was to do.
        measured_depth_m: what is gone since the first scan, by the fields fitted to that and to the scan after it.
        waypoints: shots planned.
        given_up: waypoints of the raster that the planner left out.
        shots: shots fired.
        spot_error_rms_um: of the shots across the beam, as the simulator says.
        spot_error_max_um: the largest.
    """

    planning: Planning
    measured_depth_m: float
    waypoints: int
    given_up: int
    shots: int
    spot_error_rms_um: float
    spot_error_max_um: float


def next_pass(request: AblationRequest, passes: Sequence[PassReport]) -> Planning | None:
    """Return what the next pass shall do, None where the depth is reached or the passes are used up.

    What is left is split evenly over as few passes as are allowed to take it. How long the bursts must be is learnt
    from all passes so far: the depth they took over the time they fired, without a threshold. The first pass goes by
    the laser as it is taken to be.
    """
    gone_m = passes[-1].measured_depth_m if passes else 0.0
    left_m = request.depth_m - gone_m
    if len(passes) >= request.most_passes or left_m <= request.tolerance_m:
        return None
    depth_m = left_m / math.ceil(left_m / request.largest_pass_m - 1e-9)
    dwell_s = request.laser.dwell_for(depth_m, request.spacing_m, request.spacing_m)
    if gone_m > _LEARNING_DEPTH_M:
        dwell_s = depth_m * sum(done.planning.dwell_s for done in passes) / gone_m
    return Planning(depth_m, dwell_s)
