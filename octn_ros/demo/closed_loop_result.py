"""The figures of one closed loop, for machines and for people."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo.ablation_request import AblationRequest
from octn_ros.demo.closed_loop import ClosedLoopRecord
from octn_ros.volume import VolumeGeometry


@dataclass(frozen=True)
class PassFigures:
    """One pass: micrometres along the beam, milliseconds, and shots.

    Attributes:
        planned_um: depth that the pass was to take.
        dwell_ms: length of its bursts.
        measured_um: depth gone since the first scan, by the fitted fields: median inside the band.
        true_um: the same by the simulator's own map.
        shots: shots fired.
        given_up: waypoints that the planner left out.
        spot_error_rms_um: of the shots, across the beam.
        spot_error_max_um: the largest.
    """

    planned_um: float
    dwell_ms: float
    measured_um: float
    true_um: float
    shots: int
    given_up: int
    spot_error_rms_um: float
    spot_error_max_um: float


@dataclass(frozen=True)
class ClosedLoopResult:
    """What came out of one run; depths are along the beam, the truth is the simulator's own map of what is gone.

    Attributes:
        source: the phantom.
        requested_um: the depth asked for.
        rectangle_mm: its two corners x0, y0, x1, y1.
        band_um: width of the band along the edges that is left out: one spot radius.
        rms_error_um: root mean square of what is gone less what was asked for, inside the band: the truth.
        median_error_um: median of the same.
        max_error_um: the largest, either way.
        field_rms_error_um: the same as the fields before and after measure it.
        removed_mm3: volume gone.
        requested_mm3: area of the rectangle times the depth.
        spilled_um: the deepest place further than the band outside the rectangle.
        shots: shots fired in all passes.
        shots_outside: those whose actual place lies outside the rectangle by more than half a spot.
        farthest_outside_um: how far the outermost lies outside, 0 where none does.
        passes: one after the other.
        audit: the record of the executions.
        report: the report that was written.
        seconds: duration of each kind of step.
    """

    source: str
    requested_um: float
    rectangle_mm: tuple[float, float, float, float]
    band_um: float
    rms_error_um: float
    median_error_um: float
    max_error_um: float
    field_rms_error_um: float
    removed_mm3: float
    requested_mm3: float
    spilled_um: float
    shots: int
    shots_outside: int
    farthest_outside_um: float
    passes: tuple[PassFigures, ...]
    audit: str
    report: str
    seconds: dict[str, float]

    def to_plain(self) -> dict[str, Any]:
        """Return the figures as a dict that JSON can hold."""
        return dataclasses.asdict(self)

    def rows(self) -> list[tuple[str, str]]:
        """Return the figures in words, (name, value with unit), for the table and the report."""
        x0, y0, x1, y1 = self.rectangle_mm
        rows = [
            ("scanned", self.source),
            ("asked for", f"{self.requested_um:.0f} um over {x1 - x0:.2f} x {y1 - y0:.2f} mm"),
            (
                "RMS error of what is gone (truth)",
                f"{self.rms_error_um:.1f} um, {self.band_um:.0f} um of edge left out",
            ),
            ("  median", f"{self.median_error_um:+.1f} um"),
            ("  largest", f"{self.max_error_um:.1f} um"),
            ("  by the fitted fields, RMS", f"{self.field_rms_error_um:.1f} um"),
            ("volume gone", f"{self.removed_mm3:.3f} mm^3 of {self.requested_mm3:.3f} mm^3 asked for"),
            ("deepest spill beyond the band", f"{self.spilled_um:.1f} um"),
            ("shots", f"{self.shots}, {self.shots_outside} outside by more than half a spot"),
            ("  farthest outside", f"{self.farthest_outside_um:.1f} um"),
        ]
        for number, done in enumerate(self.passes, 1):
            rows.append(
                (
                    f"pass {number}",
                    f"{done.planned_um:.0f} um with bursts of {done.dwell_ms:.2f} ms; gone by the fields "
                    f"{done.measured_um:.1f} um, in truth {done.true_um:.1f} um; {done.given_up} waypoints given up",
                )
            )
        parts = ", ".join(f"{name} {value:.1f}" for name, value in self.seconds.items())
        return [*rows, ("audit record", self.audit), ("run", f"{sum(self.seconds.values()):.1f} s ({parts})")]


def closed_loop_result(
    source: str,
    geometry: VolumeGeometry,
    request: AblationRequest,
    record: ClosedLoopRecord,
    audit: Path,
    report: Path,
    seconds: dict[str, float],
) -> ClosedLoopResult:
    """Work the figures out.

    Args:
        source: the phantom in words.
        geometry: of its scans, at whose A-scans the truth is known.
        request: what was asked for.
        record: what came over the graph.
        audit: the record of the executions, read for the places of the shots.
        report: where the report is written to.
        seconds: duration of each kind of step.
    """
    x, y = ascan_places(geometry)
    band = request.laser.spot_radius_m
    inside = request.inside(x, y, band)
    final = record.removed_m[-1] if record.removed_m else np.zeros((len(y), len(x)))
    error_um = 1e6 * (final[inside] - request.depth_m)
    measured = request.measured_depths_m(record.surfaces[0], record.surfaces[-1])
    outside_m = shots_outside_m(request, audit)
    (x0, y0), (x1, y1) = request.corners_m
    return ClosedLoopResult(
        source=source,
        requested_um=1e6 * request.depth_m,
        rectangle_mm=(1e3 * x0, 1e3 * y0, 1e3 * x1, 1e3 * y1),
        band_um=1e6 * band,
        rms_error_um=_rms(error_um),
        median_error_um=float(np.median(error_um)),
        max_error_um=float(np.abs(error_um).max()),
        field_rms_error_um=_rms(1e6 * (measured - request.depth_m)),
        removed_mm3=float(final.sum()) * geometry.spacing_m[0] * geometry.spacing_m[2] * 1e9,
        requested_mm3=(x1 - x0) * (y1 - y0) * request.depth_m * 1e9,
        spilled_um=1e6 * float(np.max(final[~request.inside(x, y, -band)], initial=0.0)),
        shots=len(outside_m),
        shots_outside=int(np.count_nonzero(outside_m > band)),
        farthest_outside_um=1e6 * float(np.max(outside_m, initial=0.0)),
        passes=tuple(
            PassFigures(
                planned_um=1e6 * done.planning.depth_m,
                dwell_ms=1e3 * done.planning.dwell_s,
                measured_um=1e6 * done.measured_depth_m,
                true_um=1e6 * float(np.median(removed[inside])),
                shots=done.shots,
                given_up=done.given_up,
                spot_error_rms_um=done.spot_error_rms_um,
                spot_error_max_um=done.spot_error_max_um,
            )
            for done, removed in zip(record.passes, record.removed_m, strict=True)
        ),
        audit=str(audit),
        report=str(report),
        seconds=seconds,
    )


def ascan_places(geometry: VolumeGeometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x [lateral] and y [bscan] of the A-scans of a scan in the OCT frame, metres."""
    (bscans, _, laterals), (along, _, across) = geometry.shape, geometry.spacing_m
    x, y, _ = geometry.origin_m
    return np.asarray(x + across * np.arange(laterals)), np.asarray(y + along * np.arange(bscans))


def shots_outside_m(request: AblationRequest, audit: Path) -> NDArray[np.float64]:
    """Return how far the actual place of each shot [S] of an audit record lies outside the rectangle, metres."""
    lines = [json.loads(line) for line in audit.read_text(encoding="utf-8").splitlines()]
    places = np.array([line["actual_m"][:2] for line in lines if line["event"] == "shot"]).reshape(-1, 2)
    low, high = np.array(request.corners_m)
    return np.asarray(np.linalg.norm(np.maximum(np.maximum(low - places, places - high), 0.0), axis=1))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
