"""Plans as an arm receives them: messages that belong together, from one planner that stands for them."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.errors import ExecutionError, in_words
from octn_ros.nodes import conversions, diagnostics, qos, status
from octn_ros.simulation import LaserPath, Voucher

SAME = 1e-6  # metres and cosines: float32 of the tool path against float64 of the waypoints, at metres from the flange
LOOK_S = 0.1  # between two looks at who publishes


class PlanInbox:
    """Subscribes to `waypoints`, `tool_path` and `plan_status`, and hands plans over once both halves are here.

    What the planner stands for is told by its `plan_status`, and that it lives and still does by its reports on
    `/diagnostics`, which name the plan too. Of several publishers nobody can tell which said what, so all of it is
    forgotten then.

    Args:
        node: the node that listens.
        received: called with each whole plan; returns whether it is done with it. If not it is called again with the
            same plan at each sign of the planner.
        withdrawn: called with the reason why the last plan is over: its planner has taken it back, by empty waypoints
            or an empty tool path, or is gone.
        refused: called with the reason why messages make no plan.
    """

    def __init__(
        self,
        node: Node,
        received: Callable[[LaserPath], bool],
        withdrawn: Callable[[str], None],
        refused: Callable[[str], None],
    ) -> None:
        self._received, self._withdrawn, self._refused = received, withdrawn, refused
        self._was_there = False
        self._forget()
        self._sources = {
            topic: node.create_subscription(kind, topic, heard, qos.LATCHED)
            for topic, kind, heard in (
                ("waypoints", PoseArray, self._on_waypoints),
                ("tool_path", PointCloud2, self._on_tool_path),
                ("plan_status", DiagnosticArray, self._on_report),
            )
        }
        node.create_subscription(DiagnosticArray, diagnostics.TOPIC, self._on_life, qos.STREAM)
        node.create_timer(LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def voucher(self) -> Voucher:
        """Return what is known of the planner now; safe from any thread.

        A planner that is killed leaves the graph when its connection breaks: at once on one machine under the embedded
        runtime, after the lease of the participant (some seconds) under DDS. One that hangs stays in it, silent.
        """
        lived_s, lives_for = self._lived
        return dataclasses.replace(
            self._said, publishers=self._publishers(), silent_s=time.monotonic() - lived_s, lives_for=lives_for
        )

    def _publishers(self) -> dict[str, int]:
        return {topic: source.get_publisher_count() for topic, source in self._sources.items()}

    def _forget(self) -> None:
        self._waypoints: PoseArray | None = None
        self._tool_path: PointCloud2 | None = None
        self._path: LaserPath | None = None  # a whole plan until it is taken
        self._said = Voucher({})
        self._lived = -math.inf, ""  # when the planner gave a sign of life, and the plan that it named

    def _look(self) -> None:
        voucher = self.voucher()
        was, self._was_there = self._was_there, voucher.why_nobody is None
        several = max(voucher.publishers.values()) > 1
        if (was and not self._was_there) or several:
            heard = self._said.node or self._waypoints is not None or self._tool_path is not None
            self._forget()
            if heard and voucher.why_nobody is not None:
                (self._refused if several else self._withdrawn)(voucher.why_nobody)

    def _on_report(self, message: DiagnosticArray) -> None:
        if not message.status:
            return
        _, _, values = status.read(message)
        said = Voucher(
            {},
            planner=message.status[0].name.partition(":")[0],
            node=values.get("node", ""),
            scan=values.get("stamp_ns", ""),
            plan_hash=values.get("plan_hash", ""),
            field_hash=values.get("field_hash", ""),
        )
        if said.node != self._said.node:
            self._lived = -math.inf, ""
        self._said = said
        self._offer()

    def _on_life(self, message: DiagnosticArray) -> None:
        for told in message.status:
            if self._said.node and told.name.partition(":")[0] == self._said.node:
                named = {pair.key: pair.value for pair in told.values}.get("plan_hash", "")
                self._lived = time.monotonic(), named
                self._offer()

    def _on_waypoints(self, message: PoseArray) -> None:
        self._waypoints = message
        self._on_half(len(message.poses))

    def _on_tool_path(self, message: PointCloud2) -> None:
        self._tool_path = message
        self._on_half(message.width * message.height)

    def _on_half(self, waypoints: int) -> None:
        self._path = None
        if not waypoints:
            self._withdrawn("the planner has withdrawn the plan; plan again")  # whoever says so
            return
        self._join()
        self._offer()

    def _offer(self) -> None:
        self._look()
        if self._path is not None and self._received(self._path):
            self._path = None

    def _join(self) -> None:
        """Two plans of one scan have equal stamps, so the poses are held against each other too."""
        waypoints, tool_path = self._waypoints, self._tool_path
        if waypoints is None or tool_path is None or waypoints.header.stamp != tool_path.header.stamp:
            return
        try:
            frames = waypoints.header.frame_id, tool_path.header.frame_id
            if frames[0] != frames[1]:
                raise ExecutionError(
                    f"expected waypoints and tool_path in one frame, got {frames[0]!r} and {frames[1]!r}"
                )
            rows = conversions.cloud_to_tool_path(tool_path)
            poses, confirmed = conversions.tool_path_poses(rows), conversions.poses_to_matrices(waypoints.poses)
            if len(poses) != len(confirmed) or np.abs(poses - confirmed).max() > SAME:
                return  # one of the two belongs to another plan; its partner is still to come
            self._path = LaserPath(
                poses,
                rows["segment"].astype(np.int32),
                rows["laser_on"].astype(bool),
                rows["speed"].astype(np.float64),
                conversions.stamp_to_ns(tool_path.header.stamp),
                tool_path.header.frame_id,
                conversions.plan_hash(tool_path),
            )
        except Exception as error:  # whatever the message holds, the node lives on
            self._refused(in_words(error))
