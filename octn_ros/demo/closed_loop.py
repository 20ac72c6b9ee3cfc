"""The closed loop over the graph: scan, fit, plan, ablate one pass, scan again and see, until the depth is reached."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import octn_ros.nodes  # noqa: F401 - makes the message packages importable where ROS 2 is missing

# isort: split
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image

from octn_ros.demo.ablation_request import AblationRequest, PassReport, Planning, next_pass
from octn_ros.demo.graph import DemoError, demo_graph
from octn_ros.demo.services import ANSWER_S, enable_laser, plan_rectangle, trigger
from octn_ros.demo.session import EXECUTION_S, FIT_GRACE_S, SCAN_S, Show, Stopwatch
from octn_ros.demo.source import ScanSource
from octn_ros.field import field_hash, loads_field
from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.client import GraphClient, Watch
from octn_ros.query import SurfaceMap, SurfaceMapConfig, surface_map

SURFACE_ASCANS = 16_384  # at which the fitted fields are asked for the depth of the surface


@dataclass(frozen=True, eq=False)
class ClosedLoopRecord:
    """What came over the graph in one run; read-only.

    Attributes:
        passes: one report for each pass fired.
        surfaces: the surface of the fitted field before the first pass and after each one.
        removed_m: what the simulator says is gone at each A-scan [bscan, lateral] after each pass, metres: the truth.
        executions: the simulator's last report of each pass, values by name.
        seconds: duration of each kind of step, summed up.
    """

    passes: tuple[PassReport, ...]
    surfaces: tuple[SurfaceMap, ...]
    removed_m: tuple[NDArray[np.float64], ...]
    executions: tuple[dict[str, str], ...]
    seconds: dict[str, float]


def run_closed_loop(
    source: ScanSource,
    request: AblationRequest,
    fit_parameters: Mapping[str, Any],
    simulator_parameters: Mapping[str, Any],
    audit_path: Path,
    show: Show,
    record: Path | None = None,
) -> ClosedLoopRecord:
    """Ablate as requested, one pass after the other, each planned on a new scan.

    Args:
        source: the phantom under the probe.
        request: where and how deep, and what is known of the laser beforehand.
        fit_parameters: of the trainer.
        simulator_parameters: errors of the platform and the like, over those of the source.
        audit_path: where the record of the executions goes.
        show: told what is going on. Called from several threads.
        record: a file for a recording of the graph, None for none.

    Raises:
        DemoError: a node refused, failed or did not answer in time.
        OctnError: a node cannot start with its parameters.
    """
    parameters = _parameters(source, request, fit_parameters, simulator_parameters, audit_path)
    with demo_graph(parameters, record) as client:
        loop = _Loop(client, source, request, float(fit_parameters["fit.time_budget_s"]), show)
        return loop.run()


def _parameters(
    source: ScanSource,
    request: AblationRequest,
    fit_parameters: Mapping[str, Any],
    simulator_parameters: Mapping[str, Any],
    audit_path: Path,
) -> dict[str, dict[str, Any]]:
    laser = request.laser
    return {
        "simulator": {
            **source.simulator_parameters,
            "audit_path": str(audit_path),
            "operator": "octn demo --closed-loop",
            "laser.power_w": laser.power_w,
            "laser.duty_cycle": laser.duty_cycle,
            "laser.sigma_m": laser.sigma_m,
            "laser.order": laser.order,
            **simulator_parameters,
        },
        "trainer": {
            **source.trainer_parameters,
            "warm_start": True,
            **fit_parameters,
        },
        "planner": {
            "raster.point_spacing_m": request.spacing_m,
            "raster.point_spacing_along": "lateral",  # as deep on a slope as beside it
            "raster.margin_m": request.spacing_m / 2,  # each shot stands for the cell about it
        },
    }


class _Loop:
    """One run, while the graph stands."""

    def __init__(
        self, client: GraphClient, source: ScanSource, request: AblationRequest, fit_budget_s: float, show: Show
    ) -> None:
        self._client, self._source, self._request, self._show = client, source, request, show
        self._fit_budget_s = fit_budget_s
        self._watch = Stopwatch()
        self._fit_progress = client.watch(DiagnosticArray, "fit_progress", qos.LATCHED)
        self._field = client.watch(CompressedImage, "field", keep=1)
        self._plan_status = client.watch(DiagnosticArray, "plan_status")
        self._execution = client.watch(DiagnosticArray, "execution_status")
        self._removed = client.watch(Image, "removed_depth")
        self._fit_progress.wait_matched(ANSWER_S)
        self._removed.wait(ANSWER_S)  # nothing yet; from here on there is one for each execution

    def run(self) -> ClosedLoopRecord:
        request = self._request
        identity, surface = self._look()
        surfaces, truths, executions = [surface], [], []
        passes: list[PassReport] = []
        while (planning := next_pass(request, passes)) is not None:
            number = len(passes) + 1
            plan = self._plan(identity, number)
            execution = self._fire(plan, planning, number)
            truths.append(self._removed_map(number))
            identity, surface = self._look()
            surfaces.append(surface)
            measured = request.measured_depth_m(surfaces[0], surface)
            passes.append(
                PassReport(
                    planning=planning,
                    measured_depth_m=measured,
                    waypoints=int(plan["waypoints"]),
                    given_up=int(plan["given_up"]),
                    shots=int(execution["shots"]),
                    spot_error_rms_um=float(execution["spot_error_rms_um"]),
                    spot_error_max_um=float(execution["spot_error_max_um"]),
                )
            )
            executions.append(execution)
        return ClosedLoopRecord(
            tuple(passes), tuple(surfaces), tuple(truths), tuple(executions), dict(self._watch.seconds)
        )

    def _look(self) -> tuple[str, SurfaceMap]:
        """Scan, wait for the fitted field and for the planner to have it; return its hash and its surface."""
        seen = len(self._execution.messages)
        self._show("scanning", 0.0, "")
        with self._watch.part("scan"):
            trigger(self._client, "scan", SCAN_S)
            said = self._later(self._execution, seen, SCAN_S, lambda values, text: text.startswith("scanning"))
            stamp = said["scan_stamp_ns"]
        with self._watch.part("fit"):
            fitted = self._fitted(stamp)
            message = self._field.wait(
                ANSWER_S, lambda message: field_hash(conversions.field_data(message)) == fitted["field_hash"]
            )
            identity = fitted["field_hash"]
            self._plan_status.wait(ANSWER_S, lambda report: status.read(report)[2].get("field_hash") == identity)
        with self._watch.part("measure"):
            field = loads_field(conversions.field_data(message))
            surface = surface_map(field, SurfaceMapConfig(max_ascans=SURFACE_ASCANS))
        return identity, surface

    def _fitted(self, stamp: str) -> dict[str, str]:
        good, bad = ("done",), ("refused", "failed", "cancelled", "superseded")
        self._show("fitting the field", 0.0, "")

        def ended(report: DiagnosticArray) -> bool:
            values = status.read(report)[2]
            state = values.get("state")
            return state == "refused" or (values.get("stamp_ns") == stamp and state in (*good, *bad))

        _, words, values = status.read(self._fit_progress.wait(SCAN_S + self._fit_budget_s + FIT_GRACE_S, ended))
        if values["state"] in bad:
            raise DemoError(words)
        return values

    def _plan(self, identity: str, number: int) -> dict[str, str]:
        self._show("planning", 0.0, f"pass {number}")
        frame = self._source.volume.geometry.frame
        with self._watch.part("plan"):
            return plan_rectangle(
                self._client, self._plan_status, self._request.corners_m, frame, self._request.spacing_m, identity
            )

    def _fire(self, plan: dict[str, str], planning: Planning, number: int) -> dict[str, str]:
        depth_um = planning.depth_m * 1e6
        self._show("ablating", 0.0, f"pass {number}: {depth_um:.0f} um with bursts of {planning.dwell_s * 1e3:.2f} ms")
        with self._watch.part("ablate"):
            stamp = plan["stamp_ns"]
            self._execution.wait(
                ANSWER_S,
                lambda report: (
                    (values := status.read(report)[2])["state"] == "staged" and values["scan_stamp_ns"] == stamp
                ),
            )
            dwell = Parameter("laser.dwell_s", value=planning.dwell_s).to_parameter_msg()
            asked = SetParameters.Request(parameters=[dwell])
            (result,) = self._client.call(SetParameters, "simulator/set_parameters", asked, ANSWER_S).results
            if not result.successful:
                raise DemoError(f"simulator: laser.dwell_s: {result.reason}")
            enable_laser(self._client)
            seen = len(self._execution.messages)
            trigger(self._client, "execute", SCAN_S)
            ended = self._later(
                self._execution, seen, EXECUTION_S, lambda values, text: values["state"] in ("done", "aborted")
            )
        if ended["state"] == "aborted":
            raise DemoError(status.read(self._execution.messages[-1])[1])
        return ended

    def _removed_map(self, number: int) -> NDArray[np.float64]:
        self._removed.wait(ANSWER_S, lambda message: len(self._removed.messages) > number)
        return conversions.image_to_array(self._removed.messages[number]).astype(np.float64)

    def _later(
        self, watch: Watch[Any], seen: int, timeout_s: float, accept: Callable[[dict[str, str], str], bool]
    ) -> dict[str, str]:
        """Return the values of the first report after the `seen` first ones that is accepted by values and words."""

        def wanted(report: DiagnosticArray) -> bool:
            _, words, values = status.read(report)
            return accept(values, words)

        return status.read(watch.wait(timeout_s, wanted, after=seen))[2]
