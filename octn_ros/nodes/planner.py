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
from geometry_msgs.msg import PoseArray, PoseStamped
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from octn_ros.errors import OctnError, PlanError
from octn_ros.field.device import DEVICE_DESCRIPTION, torch_device
from octn_ros.nodes import conversions, process, qos, status
from octn_ros.nodes.field_receiver import FieldReceiver, ReceivedField
from octn_ros.nodes.frames import ScanFrames
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.nodes.worker import run_aside
from octn_ros.planning import (
    Plan,
    PlannerConfig,
    Region,
    RegionConfig,
    load_calibration,
    load_keep_out,
    plan_region,
    rectangle_region,
)
from octn_ros.resources import config_path
from octn_ros.settings import check_settings, setting
from octn_ros.training.warm_up import warm_up_queries

KEPT_POSES = 8  # scan_ee_pose of the last scans: the pose of a scan comes before its field

# What a service is asked to plan, from the present field and the pose of its scan.
Wanted = Callable[[ReceivedField, "NDArray[np.float64] | None"], tuple[Region, PlannerConfig]]


@dataclass(frozen=True)
class PlannerNodeConfig:
    """What the planner has to be told about its surroundings."""

    device: str = setting("auto", DEVICE_DESCRIPTION)
    calibration: str = setting("", "calibration file (YAML); empty = the package's config/calibration.yaml")
    keep_out: str = setting("", "file of keep-out regions (YAML) that no plan may touch; empty = none")

    def __post_init__(self) -> None:
        check_settings(self)


class Planner(Node):
    """Plans rasters over the present field on request, and withdraws the plan when a new field comes.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("planner", namespace=namespace, **options)
        config = ConfigParameters(self, PlannerNodeConfig(), read_only=True).config()
        self._planner_config = ConfigParameters(self, PlannerConfig())
        self._region_config = ConfigParameters(self, RegionConfig(), "region")
        self._calibration = load_calibration(config.calibration or config_path("calibration.yaml"))
        self._keep_out = load_keep_out(config.keep_out, self._calibration) if config.keep_out else ()
        self._scan_poses: dict[int, NDArray[np.float64]] = {}
        self._plan_stands = False

        self._status = status.StatusTopic(self, "plan_status", qos.LATCHED)
        self._waypoints = self.create_publisher(PoseArray, "waypoints", qos.LATCHED)
        self._waypoints_base = self.create_publisher(PoseArray, "waypoints_base", qos.LATCHED)
        self._waypoints_oct = self.create_publisher(PoseArray, "waypoints_oct", qos.LATCHED)
        self._tool_path = self.create_publisher(PointCloud2, "tool_path", qos.LATCHED)
        # One group for all of them: no field arrives in the middle of a plan, so no plan mixes two fields.
        group = MutuallyExclusiveCallbackGroup()
        device = torch_device(config.device)
        self._fields = FieldReceiver(self, device, self._on_field, self._on_bad_field, group)
        self.create_subscription(PoseStamped, "scan_ee_pose", self._on_scan_ee_pose, qos.LATCHED, callback_group=group)
        self.create_service(GetPlan, "plan_raster", self._plan_raster, callback_group=group)
        self.create_service(Trigger, "replan", self._replan, callback_group=group)
        self.get_logger().info(
            f"ready: device {device}, calibration {self._calibration.deviation:.1e} from orthonormal, "
            f"{len(self._keep_out)} keep-out regions"
        )
        run_aside(lambda: warm_up_queries(device=device), "warm-up")

    # --- fields and poses

    def _on_field(self, received: ReceivedField) -> None:
        of_field = {
            "state": "ready",
            "stamp_ns": received.stamp_ns,
            "field_hash": received.hash,
            "field_kind": received.field.kind,
        }
        if self._plan_stands:
            self._withdraw(received)
            self._status.report(status.WARN, "a new field has come; the plan of the last one is withdrawn", of_field)
        else:
            self._status.report(status.OK, "a field has come; ready to plan", of_field)

    def _on_bad_field(self, reason: str) -> None:
        self._status.report(status.ERROR, f"field refused, the last one is kept: {reason}", {"state": "refused"})

    def _on_scan_ee_pose(self, message: PoseStamped) -> None:
        base = self._calibration.base_frame
        if message.header.frame_id != base:
            self.get_logger().error(f"scan_ee_pose ignored: expected it in {base}, got {message.header.frame_id!r}")
            return
        try:
            pose = conversions.pose_to_matrix(message.pose)
        except OctnError as error:
            self.get_logger().error(f"scan_ee_pose ignored: {error}")
            return
        self._scan_poses[conversions.stamp_to_ns(message.header.stamp)] = pose
        while len(self._scan_poses) > KEPT_POSES:
            del self._scan_poses[next(iter(self._scan_poses))]

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

        plan, _ = self._plan("plan_raster", requested)
        if plan is not None:
            response.plan = conversions.to_path(plan.waypoints_ee, plan.stamp_ns, self._calibration.ee_frame)
        return response

    def _replan(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def configured(received: ReceivedField, _: NDArray[np.float64] | None) -> tuple[Region, PlannerConfig]:
            return self._region_config.config().region(received.field.geometry), self._planner_config.config()

        plan, response.message = self._plan("replan", configured)
        response.success = plan is not None
        return response

    def _plan(self, service: str, wanted: Wanted) -> tuple[Plan | None, str]:
        """Plan and publish what a service was asked for; or report why not. Returns the plan and what happened."""
        try:
            received = self._fields.current
            if received is None:
                raise PlanError("expected a fitted field, got none yet; scan or load a C-scan and wait for its fit")
            ee2base = self._scan_poses.get(received.stamp_ns)
            region, config = wanted(received, ee2base)
            plan = plan_region(
                received.field,
                self._calibration,
                region,
                config,
                field_hash=received.hash,
                keep_out=self._keep_out,
                scan_ee2base=ee2base,
            )
        except OctnError as error:
            reason = f"{service} refused: {error}"
            self._status.report(status.ERROR, reason, {"state": "refused"})
            return None, reason
        except Exception as error:  # a fault of ours, or memory that ran out: the node and its callers live on
            reason = f"{service} failed: {type(error).__name__}: {error}"
            self._status.report(status.ERROR, reason, {"state": "failed"})
            return None, reason
        return plan, self._publish(received, plan, ee2base)

    def _publish(self, received: ReceivedField, plan: Plan, ee2base: NDArray[np.float64] | None) -> str:
        rows = conversions.tool_path(
            plan.waypoints_ee, plan.segment, plan.laser_on, plan.speed_m_s, plan.residual, plan.confidence
        )
        base = np.empty((0, 4, 4)) if ee2base is None else ee2base @ plan.waypoints_ee
        self._send(received, rows, plan.waypoints_ee, plan.waypoints_oct, base)
        self._plan_stands = True
        text = f"{len(rows)} waypoints in {plan.seconds['total']:.2f} s, hit rate {plan.hit_rate:.1%}"
        self._status.report(status.OK, text, _figures(plan))
        return text

    def _withdraw(self, received: ReceivedField) -> None:
        nothing = np.empty((0, 4, 4))
        self._send(received, np.empty(0, conversions.TOOL_PATH), nothing, nothing, nothing)
        self._plan_stands = False

    def _send(
        self,
        received: ReceivedField,
        rows: NDArray[np.void],
        ee: NDArray[np.float64],
        oct_: NDArray[np.float64],
        base: NDArray[np.float64],
    ) -> None:
        stamp_ns, calibration = received.stamp_ns, self._calibration
        self._tool_path.publish(conversions.to_cloud(rows, stamp_ns, calibration.ee_frame))
        self._waypoints_oct.publish(conversions.to_pose_array(oct_, stamp_ns, received.frame))
        if len(base) or self._plan_stands:  # without a pose there is nothing to say, except that the old ones are over
            self._waypoints_base.publish(conversions.to_pose_array(base, stamp_ns, calibration.base_frame))
        self._waypoints.publish(conversions.to_pose_array(ee, stamp_ns, calibration.ee_frame))


def _figures(plan: Plan) -> dict[str, Any]:
    return {
        "state": "planned",
        "stamp_ns": plan.stamp_ns,
        "field_kind": plan.field_kind,
        "field_hash": plan.field_hash,
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
