"""The figures of one demo run, for machines and for people."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class DemoResult:
    """What came out of one run; every figure is computed from what came over the graph, None where it cannot be.

    Attributes:
        source: what was scanned: the phantom's name or the file.
        fit_s: duration of the fit.
        steps: gradient steps of the fit.
        psnr_db: field against the measured voxels.
        psnr_truth_db: field against the noise-free phantom.
        gaussian_psnr_truth_db: the measured volume after a Gaussian of one voxel, against the noise-free phantom.
        psnr_bscans, bscans: the three PSNRs are taken on so many evenly spaced B-scans of so many.
        requested: waypoints of the raster.
        waypoints: waypoints of the plan.
        given_up: waypoints left out of it.
        hit_rate: share of the requested waypoints whose intensity lies within 5 % of tau.
        tau: intensity of the surface (eq. 7).
        smoothness_mm2: sum of squared second differences of depth (eq. 13).
        rms_error_um: root mean square distance of the waypoints to the true surface.
        offset_um: median signed distance, positive is deeper.
        spread_um: root mean square distance about that median.
        max_error_um: largest distance.
        method: how the surface was looked for, in words.
        executed: laser shots of the arm.
        arm_time_factor: seconds of the arm's time per second of the clock.
        field_hash: identity of the field on the wire.
        report: the report that was written.
        seconds: duration of each part of the run.
    """

    source: str
    fit_s: float
    steps: int
    psnr_db: float
    psnr_truth_db: float | None
    gaussian_psnr_truth_db: float | None
    psnr_bscans: int
    bscans: int
    requested: int
    waypoints: int
    given_up: int
    hit_rate: float
    tau: float
    smoothness_mm2: float
    rms_error_um: float | None
    offset_um: float | None
    spread_um: float | None
    max_error_um: float | None
    method: str
    executed: int
    arm_time_factor: float
    field_hash: str
    report: str | None
    seconds: dict[str, float]

    def to_plain(self) -> dict[str, Any]:
        """Return the figures as a dict that JSON can hold."""
        return dataclasses.asdict(self)

    def rows(self) -> list[tuple[str, str]]:
        """Return the figures in words, (name, value with unit), for the table and the report."""
        scope = f"{self.psnr_bscans} of {self.bscans} B-scans, evenly spaced"
        return [
            ("scanned", self.source),
            ("fit", f"{self.fit_s:.1f} s, {self.steps} steps"),
            ("PSNR against the measured voxels", f"{self.psnr_db:.2f} dB ({scope})"),
            ("PSNR against the noise-free truth", _with_unit(self.psnr_truth_db, "dB", 2)),
            ("  a Gaussian of one voxel instead", _with_unit(self.gaussian_psnr_truth_db, "dB", 2)),
            ("waypoints", f"{self.waypoints} of {self.requested}, {self.given_up} given up"),
            ("hit rate", f"{100 * self.hit_rate:.1f} % within 5 % of tau = {self.tau:.3f}"),
            ("smoothness energy", f"{self.smoothness_mm2:.4g} mm^2"),
            ("RMS distance to the true surface", _with_unit(self.rms_error_um, "um", 1)),
            ("  offset (median, + is deeper)", _with_unit(self.offset_um, "um", 1)),
            ("  spread about it (RMS)", _with_unit(self.spread_um, "um", 1)),
            ("  largest", _with_unit(self.max_error_um, "um", 1)),
            ("surface search", self.method),
            ("executed shots", f"{self.executed}, the arm's time running {self.arm_time_factor:g} times as fast"),
            ("run", _durations(self.seconds)),
        ]


def _with_unit(value: float | None, unit: str, digits: int) -> str:
    return "unknown for a recording" if value is None else f"{value:.{digits}f} {unit}"


def _durations(seconds: dict[str, float]) -> str:
    parts = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
    return f"{sum(seconds.values()):.1f} s ({parts})"
