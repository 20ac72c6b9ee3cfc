"""The planner node: a fitted field and a region in, laser waypoints out."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from octn_ros.errors import PlanError
from octn_ros.field.device import DEVICE_DESCRIPTION, torch_device
from octn_ros.nodes import conversions, process, qos, status
from octn_ros.nodes.answers import Answers
from octn_ros.nodes.diagnostics import NodeDiagnostics
from octn_ros.nodes.field_receiver import FieldReceiver, ReceivedField
from octn_ros.nodes.frames import ScanFrames
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.nodes.plan_publisher import PlanPublisher
from octn_ros.nodes.plan_view import PlanView
from octn_ros.nodes.scan_poses import ScanPoses
from octn_ros.nodes.transforms import Transforms
from octn_ros.nodes.worker import run_aside
from octn_ros.planning import (
    Plan,
    PlannerConfig,
    Region,
    RegionConfig,
    check_inside,
    count_waypoints,
    load_calibration,
    load_keep_out,
    plan_region,
    rectangle_region,
    warm_up_steps,
)
from octn_ros.resources import config_path
from octn_ros.settings import check_settings, setting
from octn_ros.training.warm_up import warm_up_queries

# What a service is asked to plan, from the present field and the pose of its scan.
Wanted = Callable[[ReceivedField, "NDArray[np.float64] | None"], tuple[Region, PlannerConfig]]


@dataclass(frozen=True)
class PlannerNodeConfig:
    """What the planner has to be told about its surroundings."""

    device: str = setting("auto", DEVICE_DESCRIPTION)
    calibration: str = setting("", "calibration file (YAML); empty = the package's config/calibration.yaml")
    keep_out: str = setting("", "file of keep-out regions (YAML) that no plan may touch; empty = none")
    largest_plan: int = setting(
        100_000, "largest number of waypoints of a plan; more are refused", low=1, high=1_000_000
    )

    def __post_init__(self) -> None:
        check_settings(self)


# Given at the start only: who can call services raises no limit, and moves no keep-out region.
READ_ONLY = ("device", "calibration", "keep_out", "largest_plan")


class Planner(Node):
    """Plans rasters over the present field on request.

    The plan is withdrawn when a new field comes, also a refused one of a new scan, or another pose of its own scan.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("planner", namespace=namespace, **options)
        self._config = ConfigParameters(self, PlannerNodeConfig(), read_only=READ_ONLY)
        config = self._config.config()
        self._planner_config = ConfigParameters(self, PlannerConfig())
        self._region_config = ConfigParameters(self, RegionConfig(), "region")
        self._calibration = load_calibration(config.calibration or config_path("calibration.yaml"))
        self._keep_out = load_keep_out(config.keep_out, self._calibration) if config.keep_out else ()

        self._diagnostics = NodeDiagnostics(self, self._describe)
        self._status = status.StatusTopic(self, "plan_status", qos.LATCHED)
        self._answers = Answers(self._diagnostics, self._status, self._standing)
        self._publisher = PlanPublisher(self, self._calibration)
        self._transforms = Transforms(self, self._calibration)
        # One group for all of them: no field arrives in the middle of a plan, so no plan mixes two fields.
        group = MutuallyExclusiveCallbackGroup()
        self._view = PlanView(self, self._calibration, self._on_bad_view, group)
        device = torch_device(config.device)
        self._fields = FieldReceiver(self, device, self._on_field, self._on_bad_field, group)
        self._scan_poses = ScanPoses(self, self._calibration.base_frame, group, self._on_other_pose)
        self.create_service(GetPlan, "plan_raster", self._plan_raster, qos_profile=qos.SERVICES, callback_group=group)
        self.create_service(Trigger, "replan", self._replan, qos_profile=qos.SERVICES, callback_group=group)
        self.get_logger().info(
            f"ready: device {device}, calibration {self._calibration.deviation:.1e} from orthonormal, "
            f"{len(self._keep_out)} keep-out regions"
        )
        run_aside(lambda: warm_up_queries(device=device), "warm-up")
        run_aside(warm_up_steps, "warm-up of the search")

    def destroy_node(self) -> None:
        """End the thread that draws, then the node."""
        self._view.close()
        super().destroy_node()

    # --- fields

    def _on_field(self, received: ReceivedField, older: str) -> None:
        level = status.WARN if older or self._publisher.stands else status.OK
        of_field = {"state": "ready", **self._told(received)}
        if self._publisher.stands:
            self._withdraw(received)
            self._status.report(level, f"a new field has come{older}; the plan of the last one is withdrawn", of_field)
        else:
            if not self._publisher.told:
                self._publisher.withdraw(received)  # who still holds a plan of a planner before this one drops it
            self._status.report(level, f"a field has come{older}; ready to plan", of_field)

    def _on_bad_field(self, reason: str, outdated: bool) -> None:
        kept = self._fields.current
        if kept is not None and outdated and self._publisher.stands:
            self._withdraw(kept)
            reason += "; the plan on the last one is withdrawn, for there is a newer scan"
        self._status.report(status.ERROR, reason, {"state": "refused", **self._standing()})
        self._diagnostics.failed(reason)

    def _on_other_pose(self, stamp_ns: int) -> None:
        received = self._fields.current
        if received is None or received.stamp_ns != stamp_ns or not self._publisher.stands:
            return
        self._withdraw(received)
        reason = "a nearer pose of the scan has come; the plan placed by the last one is withdrawn"
        self._status.report(status.WARN, reason, {"state": "ready", **self._told(received)})

    def _withdraw(self, received: ReceivedField) -> None:
        self._publisher.withdraw(received)
        self._view.clear(received)

    def _on_bad_view(self, reason: str) -> None:
        self.get_logger().error(f"the plan cannot be shown: {reason}")
        self._diagnostics.failed(f"the plan cannot be shown: {reason}")

    def _told(self, received: ReceivedField) -> dict[str, Any]:
        """Return what each report says, whatever it is about: the field, and which plan stands."""
        return {
            **received.identity(),
            "field_age_s": self._diagnostics.age_s(received.stamp_ns),
            "plan_hash": self._publisher.plan_hash,
            "node": self.get_fully_qualified_name(),
        }

    def _standing(self) -> dict[str, Any]:
        received = self._fields.current
        return self._told(received) if received else {}

    def _describe(self) -> tuple[bytes, str, dict[str, Any]]:
        received = self._fields.current
        if received is None:
            return status.OK, "no field yet", {"plan_stands": False}
        stands = self._publisher.stands
        values = {**self._told(received), "plan_stands": stands}
        return status.OK, "a plan stands" if stands else "ready to plan", values

    # --- plans

    def _plan_raster(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        def requested(received: ReceivedField, ee2base: NDArray[np.float64] | None) -> tuple[Region, PlannerConfig]:
            config = self._planner_config.config()
            line_spacing_m = conversions.shortest_decimal(request.tolerance)
            if line_spacing_m != 0.0:
                raster = dataclasses.replace(config.raster, line_spacing_m=line_spacing_m)
                config = dataclasses.replace(config, raster=raster)
            frames = ScanFrames(self._calibration, ee2base)
            start, goal = frames.to_oct(request.start), frames.to_oct(request.goal)
            angle_rad = math.atan2(start[1, 0], start[0, 0])
            return rectangle_region(start[:2, 3], goal[:2, 3], angle_rad), config

        def respond(plan: Plan) -> None:
            response.plan = conversions.to_path(plan.waypoints_ee, plan.stamp_ns, self._calibration.ee_frame)

        self._plan("plan_raster", requested, respond)
        return response

    def _replan(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def configured(received: ReceivedField, _: NDArray[np.float64] | None) -> tuple[Region, PlannerConfig]:
            return self._region_config.config().region(received.field.geometry), self._planner_config.config()

        response.success, response.message = self._plan("replan", configured)
        return response

    def _plan(
        self, service: str, wanted: Wanted, respond: Callable[[Plan], None] = lambda plan: None
    ) -> tuple[bool, str]:
        """Plan, publish and respond with what a service was asked for, or report why not; return what happened."""
        text, reason = self._answers.to(service, lambda: self._plan_and_publish(wanted, respond))
        return text is not None, text or reason

    def _plan_and_publish(self, wanted: Wanted, respond: Callable[[Plan], None]) -> str:
        received = self._fields.required()
        ee2base = self._scan_poses.ee2base(received.stamp_ns)
        region, config = wanted(received, ee2base)
        largest = self._config.config().largest_plan
        # Before it is counted: a region in the wrong unit is both outside and too large, and outside says more.
        check_inside(received.field.geometry, region.vertices_m, "raster corner")
        # Counted in the lateral plane before anything is searched; on a bent surface there may be more.
        _check_size(count_waypoints(region, config.raster), largest)
        plan = plan_region(
            received.field,
            self._calibration,
            region,
            config,
            field_hash=received.hash,
            keep_out=self._keep_out,
            scan_ee2base=ee2base,
        )
        _check_size(len(plan.segment), largest)
        self._publisher.publish(received, plan, ee2base)
        text = f"{len(plan.segment)} waypoints in {plan.seconds['total']:.2f} s, hit rate {plan.hit_rate:.1%}"
        self._status.report(status.OK, text, {**_figures(plan), **self._told(received)})
        self._diagnostics.report()  # a sign of life that names the plan, without which no arm takes it
        respond(plan)
        self._view.show(received, plan, ee2base)
        return text


def _check_size(waypoints: int, largest: int) -> None:
    if waypoints > largest:
        raise PlanError(
            f"expected at most {largest:,} waypoints (parameter largest_plan), got {waypoints:,}; take a smaller "
            "region or wider spacings"
        )


def _figures(plan: Plan) -> dict[str, Any]:
    return {
        "state": "planned",
        "method": plan.method,
        "tau": plan.tau,
        "hit_rate": plan.hit_rate,
        "smoothness_mm2": plan.smoothness_mm2,
        "waypoints": len(plan.waypoints_ee),
        "segments": int(plan.segment[-1]) + 1,
        "requested": plan.requested,
        "given_up": plan.given_up,
        "given_up_because": dict(Counter(point.reason for point in plan.given_up_points)),
        "residual_rms": float(np.sqrt(np.mean(np.square(plan.residual[plan.laser_on])))),
        "tilt_limited": int(plan.tilt_limited.sum()),
        "coverage": dataclasses.asdict(plan.coverage),
        "error_budget": plan.error_budget.to_plain(),
        "seconds": plan.seconds,
        "config": plan.config,
    }


def main(args: list[str] | None = None) -> int:
    """Run the planner as a process."""
    return process.run(Planner, args)


if __name__ == "__main__":
    sys.exit(main())
