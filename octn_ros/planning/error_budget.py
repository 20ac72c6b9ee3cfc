"""How far a laser spot may lie from where the plan puts it: each part in micrometres with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from octn_ros.planning.calibration import Calibration
from octn_ros.planning.waypoints import BEAM, WaypointConfig
from octn_ros.settings import check_settings, setting

NOT_STATED = "not stated"
# Waypoints of a local plane, itself included, and how many planes are enough for an estimate.
_NEIGHBOURS, _MAX_PLANES = 12, 2000


@dataclass(frozen=True)
class ErrorBudgetConfig:
    """What is known about the system and cannot be seen in one plan."""

    surface_spread_m: float = setting(
        0.0, "RMS of found surface points about the true surface, less their offset; 0 to estimate it by local planes",
        unit="m", low=0.0, high=1e-3,
    )  # fmt: skip
    surface_offset_m: float = setting(
        0.0, "what remains of the constant offset of the found surface after its correction; 0 = not stated", unit="m",
        low=0.0, high=1e-3,
    )  # fmt: skip
    surface_source: str = setting("", "where the spread and the offset of the system come from, in words")
    refractive_index_uncertainty: float = setting(
        0.02, "standard deviation of the tissue's refractive index", low=0.0, high=1.0
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True)
class ErrorTerm:
    """One part of the budget.

    Attributes:
        name: what errs.
        micrometres: its size (RMS, one standard deviation), None if nobody has stated it.
        source: where the number comes from.
    """

    name: str
    micrometres: float | None
    source: str


@dataclass(frozen=True)
class ErrorBudget:
    """All parts and their sum.

    Attributes:
        terms: the parts.
    """

    terms: tuple[ErrorTerm, ...]

    @property
    def total_um(self) -> float:
        """Root of the sum of squares of the stated parts: independent errors are assumed."""
        return math.sqrt(sum(term.micrometres**2 for term in self.terms if term.micrometres is not None))

    @property
    def not_stated(self) -> tuple[str, ...]:
        """Parts that nobody has stated, which the sum lacks."""
        return tuple(term.name for term in self.terms if term.micrometres is None)

    def to_plain(self) -> dict[str, object]:
        """Return the budget as JSON can hold it."""
        return {
            "total_um": self.total_um,
            "not_stated": list(self.not_stated),
            "terms": [
                {"name": term.name, "micrometres": term.micrometres, "source": term.source} for term in self.terms
            ],
        }


def error_budget(
    calibration: Calibration,
    surface_m: NDArray[np.float64],
    residual: NDArray[np.float64],
    slope_per_m: NDArray[np.float64],
    normals: NDArray[np.float64],
    waypoints: WaypointConfig,
    normal_reach_m: float,
    config: ErrorBudgetConfig | None = None,
    *,
    roots_m: NDArray[np.float64] | None = None,
    min_slope_per_m: float = 0.0,
) -> ErrorBudget:
    """Add up what is known about the errors of a plan.

    Args:
        calibration: with the residuals it was made with, if it states them.
        surface_m: surface points (x, y, z) [N, 3] in the OCT frame.
        residual: field intensity less tau there [N].
        slope_per_m: derivative of the intensity by depth there [N], per metre.
        normals: unit normals there [N, 3], along the beam if nobody asked for them.
        waypoints: where the focus lies with respect to the surface.
        normal_reach_m: lateral reach over which a normal was averaged.
        config: what is known about the system; the defaults if left out.
        roots_m: depth of the level set at the surface points [N] before it was smoothed, whose scatter is that of the
            measurement; that of `surface_m` if left out.
        min_slope_per_m: slope up to which a residual tells nothing about a distance.
    """
    config = config or ErrorBudgetConfig()
    scattered = surface_m if roots_m is None else np.column_stack([surface_m[:, :2], roots_m])
    spread = _spread(scattered, config)
    return ErrorBudget(
        (
            *_calibration_terms(calibration, surface_m),
            _field_term(residual, slope_per_m, min_slope_per_m),
            spread,
            _offset_term(config),
            *_refraction_terms(normals, waypoints, (spread.micrometres or 0.0) * 1e-6, normal_reach_m, config),
        )
    )


def local_plane_rms_m(points_m: NDArray[np.float64]) -> float:
    """RMS distance in depth of points (x, y, z) [N, 3] from planes through their 12 nearest neighbours.

    Corrected for the three numbers that each plane takes from them. Bends of the tissue within a neighbourhood count
    too, so for a rough surface this is an upper bound of the noise. NaN for fewer than 12 points.
    """
    if len(points_m) < _NEIGHBOURS:
        return math.nan
    lateral = points_m[:, :2]
    probes = np.linspace(0, len(points_m) - 1, min(len(points_m), _MAX_PLANES)).astype(np.intp)
    _, near = cKDTree(lateral).query(lateral[probes], k=_NEIGHBOURS)
    offsets = lateral[near] - lateral[near].mean(axis=1, keepdims=True)
    depth = points_m[near, 2] - points_m[near, 2].mean(axis=1, keepdims=True)
    slope = np.einsum("nij,njk,nk->ni", np.linalg.pinv(np.swapaxes(offsets, 1, 2) @ offsets),
                      np.swapaxes(offsets, 1, 2), depth)  # fmt: skip
    rest = depth - np.einsum("nki,ni->nk", offsets, slope)
    return float(np.sqrt(np.sum(rest**2) / (rest.shape[0] * (_NEIGHBOURS - 3))))


def _calibration_terms(calibration: Calibration, surface_m: NDArray[np.float64]) -> list[ErrorTerm]:
    terms = []
    for name, what in (("oct2ee", "probe on the end effector"), ("laser2ee", "laser on the end effector")):
        rms = calibration.residual_rms_m.get(name)
        if rms is None:
            source = f"{NOT_STATED} in the calibration file (residual_rms_m); `octn calibrate` writes it"
            terms.append(ErrorTerm(f"calibration {name}", None, source))
        else:
            source = f"RMS of the residuals the calibration of the {what} was made with, from its file"
            terms.append(ErrorTerm(f"calibration {name}", rms * 1e6, source))
    reach = float(np.linalg.norm(surface_m, axis=1).max())
    source = f"rotation {calibration.deviation:.1e} from orthonormal, over {reach * 1e3:.1f} mm from the OCT origin"
    terms.append(ErrorTerm("calibration rounding", calibration.deviation * reach * 1e6, source))
    return terms


def _field_term(residual: NDArray[np.float64], slope_per_m: NDArray[np.float64], least_per_m: float) -> ErrorTerm:
    rising = slope_per_m > least_per_m
    if not rising.any():
        return ErrorTerm(
            "field", None, f"{NOT_STATED}: the field does not rise along the beam at any waypoint, or hardly"
        )
    rms = float(np.sqrt(np.mean(np.square(residual[rising] / slope_per_m[rising]))))
    source = "RMS of what is left of f - tau over the field's axial slope, per waypoint"
    flat = int((~rising).sum())
    if flat:
        source += f"; without {flat} of {len(rising)} waypoints whose slope is too small for it"
    return ErrorTerm("field", rms * 1e6, source)


def _spread(surface_m: NDArray[np.float64], config: ErrorBudgetConfig) -> ErrorTerm:
    if config.surface_spread_m > 0.0:
        source = config.surface_source or "configured, source not named"
        return ErrorTerm("surface spread", config.surface_spread_m * 1e6, source)
    rms = local_plane_rms_m(surface_m)
    if math.isnan(rms):
        return ErrorTerm("surface spread", None, f"{NOT_STATED}: fewer than {_NEIGHBOURS} waypoints, no local planes")
    source = f"RMS of the level set about planes through {_NEIGHBOURS} neighbours, the tissue's roughness included"
    return ErrorTerm("surface spread", rms * 1e6, source)


def _offset_term(config: ErrorBudgetConfig) -> ErrorTerm:
    if config.surface_offset_m > 0.0:
        source = config.surface_source or "configured, source not named"
        return ErrorTerm("surface offset", config.surface_offset_m * 1e6, source)
    return ErrorTerm("surface offset", None, f"{NOT_STATED} (budget.surface_offset_m): measure it on a known surface")


def _refraction_terms(
    normals: NDArray[np.float64],
    waypoints: WaypointConfig,
    spread_m: float,
    normal_reach_m: float,
    config: ErrorBudgetConfig,
) -> list[ErrorTerm]:
    """Depth below the surface is d / n along the refracted beam, so it errs with n and with the normal (Snell)."""
    names = ("refraction, index", "refraction, tilt")
    if waypoints.depth_offset_m == 0.0:
        return [ErrorTerm(name, 0.0, "the focus does not lie below the surface") for name in names]
    n, geometric = waypoints.refractive_index, waypoints.depth_offset_m / waypoints.refractive_index
    by_index = geometric * config.refractive_index_uncertainty / n
    incidence = np.arccos(np.clip(normals @ BEAM, -1.0, 1.0))
    inside = np.arcsin(np.sin(incidence) / n)
    # Derivative of the direction inside the tissue by the tilt of the normal.
    turn = np.abs(1.0 - np.cos(incidence) / (n * np.cos(inside)))
    of_normal = math.atan2(spread_m, normal_reach_m) if normal_reach_m > 0.0 else 0.0
    by_tilt = geometric * float(np.sqrt(np.mean(turn**2))) * of_normal
    return [
        ErrorTerm(
            names[0], by_index * 1e6,
            f"index {n:g} +- {config.refractive_index_uncertainty:g} at {geometric * 1e6:.0f} um below the surface",
        ),
        ErrorTerm(
            names[1], by_tilt * 1e6,
            f"Snell's law is applied; normals uncertain by {math.degrees(of_normal):.1f} degrees (surface spread over "
            f"{normal_reach_m * 1e6:.0f} um), incidence {math.degrees(float(incidence.max())):.1f} degrees at most",
        ),
    ]  # fmt: skip
