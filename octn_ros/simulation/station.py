"""The simulated platform: scanner, arm and laser over one piece of tissue, with its interlock and its record."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import ExecutionError, in_words
from octn_ros.simulation.ablation import PhantomTissue
from octn_ros.simulation.arm import Arm, ArmConfig
from octn_ros.simulation.audit import AuditRecord
from octn_ros.simulation.execution import Execution, ExecutionOrder, Setting
from octn_ros.simulation.inaccuracy import Inaccuracy, InaccuracyConfig
from octn_ros.simulation.interlock import Conditions, InterlockConfig, why_off
from octn_ros.simulation.laser import LaserConfig
from octn_ros.simulation.laser_path import LaserPath
from octn_ros.simulation.pose import inverse
from octn_ros.simulation.scanner import Scanner
from octn_ros.simulation.shots import Shot
from octn_ros.simulation.tissue_motion import TissueMotion, TissueMotionConfig
from octn_ros.simulation.voucher import Voucher
from octn_ros.volume.volume import Volume


class _Look(NamedTuple):
    """A look at the interlock: when, how far the arm's time went then, and where the tissue lay [3]."""

    time_ns: int
    elapsed_s: float
    place_m: NDArray[np.float64]

    def stamp_ns(self, at_s: float, factor: float) -> int:
        """Return the time of the clock at a time of the arm."""
        return self.time_ns - round((self.elapsed_s - at_s) / factor * 1e9)


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where the machines sit, by the calibration file; read-only.

    Attributes:
        oct2ee: the OCT frame in the end-effector frame [4, 4].
        laser2ee: the laser frame in the end-effector frame [4, 4].
        home2base: pose of the end effector at a scan in the base frame [4, 4].
        ee_frame: name of the end-effector frame.
    """

    oct2ee: NDArray[np.float64]
    laser2ee: NDArray[np.float64]
    home2base: NDArray[np.float64]
    ee_frame: str = "tool0"


class Station:
    """The platform; not thread-safe: its owner calls it under one lock.

    A plan is staged, and fired only by `execute`, with the laser enabled and every condition of the interlock held; all
    of them are looked at again in each step, before anything is fired. A failed one turns the laser off, ends the
    execution and disables the laser, and so does an abort.

    Args:
        mounting: where the machines sit.
        arm: limits of the arm.
        inaccuracy: how far all that is from the truth.
        motion: how the tissue moves.
        tissue: the phantom under the probe, or the C-scan that is played in place of one.
        audit: the record of executions.
        now_ns: present time.

    Attributes:
        arm: the arm.
        tissue: the phantom; None for a recording, which nothing can be taken away from.
        enabled: whether the laser is enabled.
        execution: the present or last execution, None before the first.
        no_plan: why nothing is staged.
        scan_stamp_ns: acquisition time of the present scan, 0 before the first.
        has_fired: whether the laser has fired since that scan, so that the tissue is not what it shows any more.
    """

    def __init__(
        self,
        mounting: Mounting,
        arm: ArmConfig,
        inaccuracy: InaccuracyConfig,
        motion: TissueMotionConfig,
        tissue: PhantomTissue | Volume,
        audit: AuditRecord,
        now_ns: int,
    ) -> None:
        self._mounting, self._audit = mounting, audit
        errors = Inaccuracy(inaccuracy)
        self._true_oct2ee = mounting.oct2ee @ errors.oct2oct
        self.arm = Arm(arm, mounting.laser2ee, mounting.home2base, mounting.ee_frame, errors.stray)
        self.tissue = tissue if isinstance(tissue, PhantomTissue) else None
        self._recording = tissue if isinstance(tissue, Volume) else None
        self._motion = TissueMotion(motion, now_ns * 1e-9, inaccuracy.seed)
        self.enabled = False
        self.execution: Execution | None = None
        self.no_plan = "none has been received"
        self.scan_stamp_ns, self.has_fired = 0, False
        self._scan_place_m, self._scan_hash = np.zeros(3), ""
        self._look = _Look(0, 0.0, np.zeros(3))  # the last one at the interlock in an execution
        self._latest_ns = 0  # the latest time since the scan

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels of a full C-scan along (bscan, axial, lateral)."""
        return self._recording.geometry.shape if self.tissue is None else self.tissue.config.shape  # type: ignore[union-attr]

    def move_tissue(self, motion: TissueMotionConfig, now_ns: int) -> None:
        """Let the tissue move otherwise from now on."""
        self._latest_ns = max(self._latest_ns, now_ns)
        self._motion.change(motion, now_ns * 1e-9)

    def tissue_place_m(self, now_ns: int) -> NDArray[np.float64]:
        """Return where the tissue lies [3], from its place at the start, metres in the OCT frame."""
        return self._motion.place_m(now_ns * 1e-9)

    def measured_motion_m(self, now_ns: int) -> NDArray[np.float64]:
        """Return how far the tissue has moved since the scan [3] as its fiducials are tracked, in the OCT frame."""
        return self._motion.measured_m(now_ns * 1e-9) - self._scan_place_m

    # --- scans

    def look(self, place_m: NDArray[np.float64], factor: int) -> Scanner:
        """Return what a scan of the tissue at this place shows; slow where the tissue has changed.

        Raises:
            ConfigurationError: the tissue is out of the scan, or too few B-scans are left.
        """
        volume = self._recording if self.tissue is None else self.tissue.scan(place_m).volume
        assert volume is not None
        return Scanner(volume, factor)

    def at_home(self) -> bool:
        """Whether the arm stands where scans are taken."""
        return bool(np.allclose(self.arm.commanded2base, self._mounting.home2base, atol=1e-9))

    def go_home(self, now_ns: int) -> float:
        """Let the arm go where scans are taken; return how long that will take, seconds of its own time.

        Raises:
            ExecutionError: the arm is moving.
        """
        return self.arm.go_to(self._mounting.home2base, now_ns)

    def begin_scan(self, stamp_ns: int, scan_hash: str, place_m: NDArray[np.float64]) -> None:
        """Take note of a scan; a plan of the one before is withdrawn."""
        if self.arm.state == "staged":
            self.withdraw("a new scan has withdrawn the plan before it")
        self.scan_stamp_ns, self._scan_hash, self._scan_place_m = stamp_ns, scan_hash, place_m
        self._latest_ns = 0
        self.has_fired = False

    def forget_scan(self) -> None:
        """Take note that the present scan was never taken; no plan of it can be staged."""
        self.scan_stamp_ns, self._scan_hash = 0, ""

    # --- plans

    def stage(self, path: LaserPath) -> None:
        """Take a plan to be executed later.

        Raises:
            ExecutionError: there is no scan yet, or the arm refuses it.
        """
        if not self.scan_stamp_ns:
            self.arm.withdraw()
            raise ExecutionError("expected a scan before its plan, got none yet; scan and plan again")
        self.arm.stage(path, self.scan_stamp_ns, self._mounting.home2base)

    @property
    def staged(self) -> LaserPath | None:
        """The staged plan, None if there is none."""
        return self.arm.path if self.arm.state == "staged" else None

    @property
    def running(self) -> LaserPath | None:
        """The plan that is being executed, None if there is none."""
        return self.arm.path if self.arm.state == "executing" else None

    def withdraw(self, why: str) -> None:
        """Drop the staged plan, if there is one, and remember why there is none; a running one goes on."""
        if self.arm.state != "executing":
            self.no_plan = why
        self.arm.withdraw()

    # --- execution

    def execute(
        self,
        operator: str,
        laser: LaserConfig,
        interlock: InterlockConfig,
        voucher: Voucher,
        now_ns: int,
        factor: float,
    ) -> None:
        """Begin to run the staged plan.

        Args:
            operator: who answers for it.
            laser: what is fired with.
            interlock: its limits.
            voucher: what the planner stands for now.
            now_ns: present time.
            factor: seconds of the arm's time per second of the clock.

        Raises:
            ExecutionError: nothing is staged, the interlock says no, the audit record cannot be written, or the arm
                cannot follow the plan, which is then dropped.
        """
        path = self.staged
        if path is None:
            why = "" if self.arm.state == "executing" else f"; {self.no_plan}"
            raise ExecutionError(f"expected a staged plan, got none (the arm is {self.arm.state}); stage a plan{why}")
        reason = self._why_off(interlock, voucher, now_ns)
        if reason is not None:
            raise ExecutionError(reason)
        home2base = self._mounting.home2base
        order = ExecutionOrder(
            operator=operator,
            planner=voucher.planner,
            scan_stamp_ns=path.stamp_ns,
            scan_hash=self._scan_hash,
            field_hash=voucher.field_hash,
            plan_hash=path.hash,
            waypoints=len(path),
        )
        setting = Setting(
            inverse(home2base @ self._mounting.oct2ee), inverse(home2base @ self._true_oct2ee), self._scan_place_m
        )
        limits = _limits(interlock, factor)
        self.execution = Execution(order, laser, setting, self.tissue, self._audit, now_ns, limits)
        try:
            self.arm.execute(now_ns, laser.dwell_s)
        except Exception as error:
            self.withdraw(f"the last one was refused: {in_words(error)}")
            self.execution.end("aborted", in_words(error), now_ns)
            raise
        self._look = _Look(now_ns, 0.0, self.tissue_place_m(now_ns))

    def step(self, dt_s: float, interlock: InterlockConfig, voucher: Voucher, now_ns: int, factor: float) -> str | None:
        """Let `dt_s` seconds of the clock pass, unless the interlock says no.

        Limits and a factor other than those of the step before are written down first.

        Args:
            dt_s: time since the last step.
            interlock: its limits.
            voucher: what the planner stands for now.
            now_ns: present time.
            factor: seconds of the arm's time per second of the clock.

        Returns:
            Why the execution was stopped, None if it was not.
        """
        if self.arm.state != "executing":
            self.arm.step(dt_s * factor)
            return None
        try:
            if self.execution is not None:
                self.execution.note(_limits(interlock, factor), now_ns)
            reason = self._why_off(interlock, voucher, now_ns)
            if reason is not None:
                return self.stop(reason, now_ns, factor)
            before, place_m = self._look, self.tissue_place_m(now_ns)
            shots = self.arm.step(dt_s * factor)
            self._look = _Look(now_ns, self.arm.elapsed_s, place_m)
            # Where the process was held up, what began before that did so by the clock of the look before.
            stamps = [
                (before if shot.start_s < before.elapsed_s else self._look).stamp_ns(shot.start_s, factor)
                for shot in shots
            ]
            self._fire(shots, stamps)
            if self.arm.state == "done" and self.execution is not None:
                self.no_plan = "the last one has been executed"
                self.execution.end("done", "", now_ns)
        except ExecutionError as error:
            return self.stop(str(error), now_ns, factor)
        return None

    def stop(self, reason: str, now_ns: int, factor: float) -> str:
        """Turn the laser off at once and disable it, stop the arm where it is, and drop its plan; return why."""
        state, execution = self.arm.state, self.execution
        self.enabled = False
        try:
            cut = self.arm.abort()
            # Its dwell ended with the last step, whatever has happened since.
            self._fire(cut, [self._look.stamp_ns(shot.start_s, factor) for shot in cut])
        except Exception as error:  # the laser is off already; what is left to do is to say why
            reason = _and(reason, error)
        if state in ("staged", "executing"):
            self.no_plan = f"the last one was stopped: {reason}"
        if state == "executing" and execution is not None:
            try:
                execution.end("aborted", reason, now_ns)
            except Exception as error:
                reason = _and(reason, error)
        return reason

    def figures(self) -> dict[str, Any]:
        """Return the totals of the present or last execution and its order; nothing before the first."""
        if self.execution is None:
            return {}
        order = self.execution.order
        hashes = {"scan_hash": order.scan_hash, "field_hash": order.field_hash, "plan_hash": order.plan_hash}
        return {**hashes, "planner": order.planner, "operator": order.operator, **self.execution.figures()}

    def _fire(self, shots: list[Shot], stamps_ns: list[int]) -> None:
        """Fire at the tissue where it lay at the last look."""
        if shots and self.execution is not None:
            self.has_fired = True
            self.execution.fire(shots, stamps_ns, self._look.place_m)

    def _why_off(self, interlock: InterlockConfig, voucher: Voucher, now_ns: int) -> str | None:
        path = self.arm.path
        assert path is not None
        moved_m = float(np.linalg.norm(self.measured_motion_m(now_ns)))
        age_s = (now_ns - path.stamp_ns) * 1e-9
        executing = self.arm.state == "executing"
        stalled_s = (now_ns - (self._look.time_ns if executing else self._latest_ns)) * 1e-9
        if not self.arm.laser_on:
            # Nothing is done to the tissue meanwhile, and the arm just goes on later. A clock that was set back is
            # told, for the age of a plan is no longer known.
            stalled_s = min(stalled_s, 0.0)
        unvouched = voucher.why_not(path, interlock.planner_silence_s)
        return why_off(interlock, Conditions(self.enabled, age_s, unvouched, moved_m, stalled_s))


def _and(reason: str, error: Exception) -> str:
    """Add what went wrong beside a reason, if it is something else."""
    words = in_words(error)
    return reason if words in reason else f"{reason}; {words}"


def _limits(interlock: InterlockConfig, factor: float) -> dict[str, float]:
    """What may be changed while the laser fires, by the names of the simulator's parameters."""
    return {**{f"interlock.{name}": value for name, value in asdict(interlock).items()}, "time_factor": factor}
