"""The simulator node: an OCT scanner, an arm and a laser on one piece of tissue."""

from __future__ import annotations

import sys
import threading
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from octn_ros.errors import OctnError, in_words
from octn_ros.nodes import process, qos, status
from octn_ros.nodes.diagnostics import NodeDiagnostics
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.nodes.plan_inbox import PlanInbox
from octn_ros.nodes.scan_player import ScanPlayer
from octn_ros.nodes.simulator_config import FIXED, SimulatorConfig
from octn_ros.nodes.station_reports import StationReports
from octn_ros.planning import from_translation_quaternion, load_calibration
from octn_ros.resources import config_path
from octn_ros.simulation import (
    ArmConfig,
    AuditRecord,
    InaccuracyConfig,
    InterlockConfig,
    LaserConfig,
    LaserPath,
    Mounting,
    PhantomConfig,
    PhantomTissue,
    Station,
    TissueMotionConfig,
)
from octn_ros.volume import load_volume

FIRED = "the laser has fired since the scan, so the tissue is not what it was planned on any more"
STATUS_PERIOD_NS = 500_000_000  # between reports of a running execution
LONGEST_STEP = 5  # control periods: where the process is held up for longer, a lit arm and its laser wait too


class Simulator(Node):
    """Plays a C-scan when asked to, stages what the planner publishes, and runs it only on `execute`.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("simulator", namespace=namespace, **options)
        self._config = ConfigParameters(self, SimulatorConfig(), read_only=FIXED)
        self._laser = ConfigParameters(self, LaserConfig(), "laser")
        self._interlock = ConfigParameters(self, InterlockConfig(), "interlock")
        self._motion = ConfigParameters(self, TissueMotionConfig(), "tissue")
        phantom = ConfigParameters(self, PhantomConfig(), "phantom", read_only=True).config()
        arm = ConfigParameters(self, ArmConfig(), "arm", read_only=True).config()
        inaccuracy = ConfigParameters(self, InaccuracyConfig(), "inaccuracy", read_only=True).config()
        config = self._config.config()
        self._calibration = load_calibration(config.calibration or config_path("calibration.yaml"))
        home2base = from_translation_quaternion(config.arm_position_m, config.arm_orientation)
        tissue: Any = PhantomTissue(phantom)
        if config.volume_file:
            tissue = load_volume(config.volume_file, config.spacing_um if all(config.spacing_um) else None)
        self._lock = threading.RLock()  # over the station and the order of the reports
        self._station = Station(
            Mounting(self._calibration.oct2ee, self._calibration.laser2ee, home2base, self._calibration.ee_frame),
            arm,
            inaccuracy,
            self._motion.config(),
            tissue,
            AuditRecord(config.audit_file),
            self._now_ns(),
        )
        self._looking = self._called_off = False  # a scan is being made ready, and was aborted meanwhile
        self._stepped_ns = self._reported_ns = 0

        self._player = ScanPlayer(self, self._station.shape[0], config.bscan_reliability)
        self._reports = StationReports(self, self._station, self._lock, self._calibration.base_frame, self._now_ns)
        self._plans = PlanInbox(self, self._on_plan, self._on_withdrawal, self._on_bad_plan)
        self._diagnostics = NodeDiagnostics(self, self._describe)
        self.create_service(Trigger, "scan", self._scan, qos_profile=qos.SERVICES)
        # Commands have a group of their own, so that nothing slow holds an abort up.
        commands, motion = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self.create_service(Trigger, "execute", self._execute, qos_profile=qos.SERVICES, callback_group=commands)
        self.create_service(Trigger, "abort", self._abort, qos_profile=qos.SERVICES, callback_group=commands)
        self.create_service(
            SetBool, "enable_laser", self._enable_laser, qos_profile=qos.SERVICES, callback_group=commands
        )
        self.create_timer(1.0 / config.ee_pose_rate_hz, self._show_motion, callback_group=motion)
        # The control period costs a fifth of a core, so its timer runs while the arm moves only; by a steady clock, for
        # simulated time may stand or be set back while the laser is on.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._step_timer = self.create_timer(arm.control_period_s, self._step, callback_group=motion, clock=steady)
        self._step_timer.cancel()
        self._longest_step_s = LONGEST_STEP * arm.control_period_s
        shape = " x ".join(str(n) for n in self._station.shape)
        self._reports.show_laser()
        self._reports.show_removed()
        self._reports.say(status.OK, f"ready: {config.volume_file or phantom.name}, {shape} voxels")

    def destroy_node(self) -> None:
        """Turn the laser off and end the record of an execution that still runs, then the node."""
        with self._lock:
            self._station.stop("the node was ended", self._now_ns(), self._config.config().time_factor)
        super().destroy_node()

    # --- scanner

    def _scan(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._diagnostics.request("scan") as asked:
            try:
                response.message = self._begin_scan()
                response.success = True
            except OctnError as error:
                response.message = f"scan refused: {error}"
            except Exception as error:  # a fault of ours, or memory that ran out: the node and its callers live on
                response.message = f"scan failed: {type(error).__name__}: {error}"
            finally:
                self._looking = False
            if response.success:
                self._show_motion()  # one more pose near the scan's stamp, however seldom they are published
            else:
                asked.refused(response.message)
            self._reports.say(status.OK if response.success else status.WARN, response.message)
        return response

    def _begin_scan(self) -> str:
        config, station = self._config.config(), self._station
        with self._lock:
            self._check_scan()
            self._looking, self._called_off = True, False
            station.move_tissue(self._motion.config(), self._now_ns())
            place_m = station.tissue_place_m(self._now_ns())
        # Outside the lock: changed tissue takes a second to be seen, and an abort must not wait for it.
        scanner = station.look(place_m, config.bscan_factor)
        scan_hash = scanner.content_hash
        with self._lock:
            if self._called_off:
                raise OctnError("an abort was asked for while it was made ready")
            way = ""
            start_ns = self._now_ns()
            if not station.at_home():
                travel_s = station.go_home(start_ns) / config.time_factor + 2 * self._longest_step_s
                start_ns += round(travel_s * 1e9)
                self._start_stepping()
                way = f" once the arm is back, in {travel_s:.2f} s"
            station.begin_scan(start_ns, scan_hash, place_m)
            self._player.play(scanner, start_ns, config.bscan_period_s)
        spacing = f"every {scanner.spacing_m * 1e6:g} um"
        return f"scanning {scanner.count} B-scans {spacing} in {scanner.count * config.bscan_period_s:.2f} s{way}"

    def _check_scan(self) -> None:
        if self._looking or self._player.unsent:
            raise OctnError(f"a scan is running, {self._player.unsent} B-scans are still to come")
        if self._station.arm.state in ("executing", "returning"):
            raise OctnError(f"the arm is {self._station.arm.state}; wait, or abort it")
        if self._now_ns() <= 0:
            raise OctnError("the clock stands at 0; publish /clock, or set use_sim_time to false")
        if not self._player.heard:
            raise OctnError("nobody listens to bscan and bscan_pose; start the trainer")

    # --- plans

    def _on_plan(self, path: LaserPath) -> bool:
        """Stage a plan that its planner stands for; return whether that is done, be it that the plan is refused."""
        interlock = self._interlock.config()
        try:
            with self._lock:
                running = self._station.running
                if running is not None:
                    if running.hash == path.hash:
                        return True  # its other half has come a second time
                    self._stop("the planner has replaced the plan")
                unvouched = self._plans.voucher().why_not(path, interlock.planner_silence_s)
                if unvouched is not None:
                    news = self._station.no_plan != unvouched
                    self._station.withdraw(unvouched)
                    if news:
                        self._reports.say(status.WARN, f"plan of {len(path)} waypoints waits: {unvouched}", log=False)
                    return False
                self._station.stage(path)
                fired = self._station.has_fired
        except Exception as error:  # whatever the plan holds, the node lives on
            self._on_bad_plan(in_words(error))
            return True
        words = f"plan of {len(path)} waypoints staged"
        if fired:
            words += f"; {FIRED}: scan and plan again, unless a second pass is meant"
        self._reports.say(status.WARN if fired else status.OK, words)
        return True

    def _on_bad_plan(self, reason: str) -> None:
        with self._lock:
            self._station.withdraw(f"the last one was refused: {reason}")
        self._diagnostics.failed(f"plan refused: {reason}")
        self._reports.say(status.ERROR, f"plan refused: {reason}")

    def _on_withdrawal(self, reason: str) -> None:
        with self._lock:
            state = self._station.arm.state
            if state == "executing":
                self._stop(reason)
                return
            self._station.withdraw(reason)
        if state == "staged":
            self._reports.say(status.WARN, f"the staged plan is dropped: {reason}")

    # --- execution

    def _enable_laser(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        with self._lock:
            if not request.data and self._station.arm.state == "executing":
                response.message = self._stop("the laser was disabled")
            else:
                self._station.enabled = bool(request.data)
                response.message = "the laser is enabled" if request.data else "the laser is disabled"
                self._reports.say(status.OK, response.message)
        response.success = True
        return response

    def _execute(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._diagnostics.request("execute") as asked, self._lock:
            station = self._station
            try:
                if self._looking or self._player.unsent:
                    raise OctnError("a scan is running, which withdraws the plan before it")
                station.move_tissue(self._motion.config(), self._now_ns())
                config, voucher = self._config.config(), self._plans.voucher()
                laser, interlock = self._laser.config(), self._interlock.config()
                station.execute(config.operator, laser, interlock, voucher, self._now_ns(), config.time_factor)
            except Exception as error:  # a fault of ours too must not end the node
                response.message = f"execute refused: {in_words(error)}"
                asked.refused(response.message)
                self._reports.say(status.ERROR, response.message)
                return response
            self._start_stepping()
            response.success = True
            response.message = f"executing {station.arm.progress[1]} waypoints"
            if station.has_fired:
                response.message += f"; {FIRED}"
            self._reports.say(status.OK, response.message)
        return response

    def _abort(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            state = "returning" if self._looking or self._player.unsent else self._station.arm.state
            self._called_off = True
            self._stop("an abort was asked for")
            response.success = True
            response.message = {
                "executing": f"aborted after {self._station.arm.executed} shots",
                "staged": "the staged plan is dropped; nothing was executing",
                "returning": "the scan is cancelled; nothing was executing",
            }.get(state, "nothing was executing") + "; the laser is disabled"
        return response

    def _stop(self, reason: str) -> str:
        """Turn the laser off and stop; the lock is held. Returns what happened in words."""
        was = self._station.arm.state
        if was == "returning" or self._player.unsent:  # from elsewhere it would be another scan than it says
            left_out = self._player.cancel()
            self._station.forget_scan()
            reason += f"; the scan is cancelled, {left_out} B-scans are not taken"
        reason = self._station.stop(reason, self._now_ns(), self._config.config().time_factor)
        self._reports.show_laser()
        words = f"{'aborted' if was == 'executing' else 'stopped'}: {reason}"
        if was == "executing":
            self._diagnostics.failed(words)
            self._reports.show_removed()
        self._reports.say(status.WARN, words)
        return words

    def _start_stepping(self) -> None:
        self._stepped_ns = self._reported_ns = self._now_ns()
        self._step_timer.reset()

    def _step(self) -> None:
        config, interlock, motion = self._config.config(), self._interlock.config(), self._motion.config()
        voucher = self._plans.voucher()
        with self._lock:
            station, now_ns = self._station, self._now_ns()
            if station.arm.state not in ("executing", "returning"):
                self._step_timer.cancel()
                return
            station.move_tissue(motion, now_ns)
            passed_s = max(now_ns - self._stepped_ns, 0) * 1e-9
            if station.arm.state == "executing":
                passed_s = min(passed_s, self._longest_step_s)
            self._stepped_ns = now_ns
            try:
                reason = station.step(passed_s, interlock, voucher, now_ns, config.time_factor)
            except Exception as error:  # a fault of ours must not leave the laser on
                reason = station.stop(f"{type(error).__name__}: {error}", now_ns, config.time_factor)
            self._reports.show_laser()
            if reason is not None:
                self._diagnostics.failed(f"aborted: {reason}")
                self._reports.show_removed()
                self._reports.say(status.ERROR, f"aborted: {reason}")
            elif station.arm.state == "returning" and now_ns >= station.scan_stamp_ns:
                self._stop("the arm is not where scans are taken in time, for time_factor was lowered on its way")
            elif station.arm.state == "done":
                self._reports.show_removed()
                self._reports.say(status.OK, f"done: {station.arm.executed} shots")
            elif now_ns - self._reported_ns >= STATUS_PERIOD_NS:
                self._reported_ns = now_ns
                self._reports.say(status.OK, station.arm.state, log=False)

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _show_motion(self) -> None:
        with self._lock:
            self._station.move_tissue(self._motion.config(), self._now_ns())
        self._reports.show_motion()

    def _describe(self) -> tuple[bytes, str, dict[str, Any]]:
        values = self._reports.values()
        if values["scan_stamp_ns"]:
            values["scan_age_s"] = self._diagnostics.age_s(values["scan_stamp_ns"])
        return status.WARN if values["state"] == "aborted" else status.OK, values["state"], values


def main(args: list[str] | None = None) -> int:
    """Run the simulator as a process."""
    return process.run(Simulator, args)


if __name__ == "__main__":
    sys.exit(main())
