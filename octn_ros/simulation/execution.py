"""One execution of a plan: what each shot did to the tissue, the figures of all, and their record."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.simulation.ablation import PhantomTissue
from octn_ros.simulation.audit import AuditRecord
from octn_ros.simulation.laser import LaserConfig
from octn_ros.simulation.pose import inverse
from octn_ros.simulation.shots import Shot


@dataclass(frozen=True)
class ExecutionOrder:
    """Who asked for what; hashes are those of the contents, 16 hex digits, empty where they are not known.

    Attributes:
        operator: who answers for it, as the operator was named beforehand; ROS services do not know their callers.
        planner: the node that the plan came from, as its status names it.
        scan_stamp_ns: acquisition time of the scan.
        scan_hash: of the scan.
        field_hash: of the field that the plan was made on.
        plan_hash: of the plan.
        waypoints: number of its waypoints.
    """

    operator: str
    planner: str
    scan_stamp_ns: int
    scan_hash: str
    field_hash: str
    plan_hash: str
    waypoints: int


@dataclass(frozen=True, eq=False)
class Setting:
    """Where everything is during one execution; read-only.

    Attributes:
        base2oct: the robot's base in the OCT frame of the scan, as the calibration file has it [4, 4].
        true_base2oct: the same as it really is.
        scan_place_m: where the tissue lay at the scan [3], from its place at the start.
    """

    base2oct: NDArray[np.float64]
    true_base2oct: NDArray[np.float64]
    scan_place_m: NDArray[np.float64]


class Execution:
    """Fires shots at the tissue, adds them up and writes them down; not thread-safe.

    Places are those in the OCT frame of the scan, of the tissue as it was scanned: the planned one is where the planner
    meant to fire by the calibration file, the actual one where the tissue was hit, with the errors of calibration and
    arm in it and the motion of the tissue since the scan.

    Args:
        order: who asked for what.
        laser: what is fired with.
        setting: where everything is.
        tissue: what is cut; None where the scanner plays a recording, which nothing is taken away from.
        audit: the record.
        start_ns: when it began.
        limits: what the interlock and the pace of time are set to, by the names of the parameters.

    Raises:
        ExecutionError: the record cannot be written.
    """

    def __init__(
        self,
        order: ExecutionOrder,
        laser: LaserConfig,
        setting: Setting,
        tissue: PhantomTissue | None,
        audit: AuditRecord,
        start_ns: int,
        limits: dict[str, float],
    ) -> None:
        self.order, self.laser = order, laser
        self._setting, self._tissue, self._audit = setting, tissue, audit
        self._limits = limits
        self._shots = 0
        self._dwell_s = self._volume_m3 = 0.0
        self._across_squared = self._along_squared = self._across_most = 0.0
        self._before_m = None if tissue is None else tissue.removed_m.copy()
        line = {"event": "execute", "time_ns": start_ns, **asdict(order), "laser": asdict(laser), "limits": limits}
        audit.write([line], durable=True)

    def note(self, limits: dict[str, float], now_ns: int) -> None:
        """Write down which of the limits hold another value from now on.

        Args:
            limits: what they are set to now, all of them.
            now_ns: present time.

        Raises:
            ExecutionError: the record cannot be written.
        """
        changed = {name: value for name, value in limits.items() if value != self._limits[name]}
        self._limits = limits
        if changed:
            change = {"event": "change", "time_ns": now_ns}
            self._audit.write([{**change, "name": name, "value": value} for name, value in changed.items()])

    def fire(self, shots: list[Shot], stamps_ns: list[int], place_m: NDArray[np.float64]) -> None:
        """Fire.

        Args:
            shots: what the arm has fired.
            stamps_ns: when each began, by the clock that stamped the scan.
            place_m: where the tissue lies now [3], from its place at the start.

        Raises:
            ExecutionError: the record cannot be written; the shots are fired and counted, and are written with what
                comes next.
        """
        lines = [self._hit(shot, stamp_ns, place_m) for shot, stamp_ns in zip(shots, stamps_ns, strict=True)]
        if lines:
            self._audit.write(lines, happened=True)

    def end(self, outcome: str, reason: str, now_ns: int) -> None:
        """Close the record with what came out: `done` or `aborted`, and why in words.

        Raises:
            ExecutionError: the record cannot be written.
        """
        line = {"event": "end", "time_ns": now_ns, "outcome": outcome, "reason": reason}
        self._audit.write([{**line, "plan_hash": self.order.plan_hash, **self.figures()}], durable=True, happened=True)

    def figures(self) -> dict[str, Any]:
        """Return the totals: shots, their energy, what is gone, and how far actual spots lie from planned ones."""
        count = max(self._shots, 1)
        figures: dict[str, Any] = {
            "shots": self._shots,
            "dwell_s": self._dwell_s,
            "energy_j": self._dwell_s * self.laser.mean_power_w,
            "spot_error_rms_um": 1e6 * (self._across_squared / count) ** 0.5,
            "spot_error_max_um": 1e6 * self._across_most,
            "focus_error_rms_um": 1e6 * (self._along_squared / count) ** 0.5,
        }
        if self._tissue is not None and self._before_m is not None:
            removed = self._tissue.removed_m - self._before_m
            cut = removed[removed > 0.5 * removed.max()] if self._shots else removed[:0]
            figures["removed_volume_mm3"] = 1e9 * self._volume_m3
            figures["removed_depth_um"] = 1e6 * float(np.median(cut)) if cut.size else 0.0
            figures["removed_depth_max_um"] = 1e6 * float(removed.max())
        return figures

    def _hit(self, shot: Shot, stamp_ns: int, place_m: NDArray[np.float64]) -> dict[str, Any]:
        setting = self._setting
        planned = setting.base2oct @ shot.planned2base
        actual = setting.true_base2oct @ shot.focus2base
        focus2tissue = actual.copy()
        focus2tissue[:3, 3] -= place_m
        actual[:3, 3] += setting.scan_place_m - place_m
        off = inverse(planned) @ actual[:, 3]
        across, along = float(np.hypot(off[0], off[1])), float(off[2])
        volume = 0.0 if self._tissue is None else self._tissue.fire(focus2tissue, shot.dwell_s, self.laser)
        self._shots += 1
        self._dwell_s += shot.dwell_s
        self._volume_m3 += volume
        self._across_squared += across**2
        self._along_squared += along**2
        self._across_most = max(self._across_most, across)
        return {
            "event": "shot",
            "time_ns": stamp_ns,
            "waypoint": shot.waypoint,
            "planned_m": _rounded(planned[:3, 3]),
            "actual_m": _rounded(actual[:3, 3]),
            "dwell_s": round(shot.dwell_s, 9),
            "power_w": self.laser.power_w,
            "duty_cycle": self.laser.duty_cycle,
            "removed_m3": float(f"{volume:.6g}"),
        }


def _rounded(place_m: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 9) for value in place_m]
