"""A plan for the eyes: path, markers and a picture, made beside the executor after the robot's topics are out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Image
from visualization_msgs.msg import MarkerArray

from octn_ros.errors import OctnError
from octn_ros.nodes import conversions, qos
from octn_ros.nodes.field_receiver import ReceivedField
from octn_ros.nodes.latest_work import LatestWork
from octn_ros.nodes.plan_pieces import GIVEN_UP_COLOUR, PlanPieces, plan_pieces
from octn_ros.nodes.plan_preview import draw_preview
from octn_ros.planning import Calibration, Plan
from octn_ros.volume import VolumeGeometry

_WORDS_NONE = ("no plan: the last one is withdrawn", "")


@dataclass(frozen=True)
class _Shown:
    """What was last asked to be shown; without a plan, that there is none."""

    received: ReceivedField
    plan: Plan | None
    ee2base: NDArray[np.float64] | None


class PlanView:
    """Publishes `path`, `plan_markers` and `plan_preview`, latched, of the present plan, in a thread of its own.

    The thread begins after the callback that asked for it, so that the answer of a service goes out first: the thread
    would take the processor from whatever is still to be done.

    Path and markers lie in the robot's base, where the tissue stays as the arm moves, or in the end-effector frame
    where the pose at the time of the scan is not known. The preview is drawn over the scan's `enface` view, again
    where that comes after the plan. All are stamped with the time of the scan.

    Args:
        node: the node that publishes.
        calibration: relates the frames.
        failed: told why something could not be shown.
        planning: callback group of the services that ask for plans to be shown.
    """

    def __init__(
        self,
        node: Node,
        calibration: Calibration,
        failed: Callable[[str], None],
        planning: MutuallyExclusiveCallbackGroup,
    ) -> None:
        self._calibration, self._failed = calibration, failed
        self._path = node.create_publisher(Path, "path", qos.LATCHED)
        self._markers = node.create_publisher(MarkerArray, "plan_markers", qos.LATCHED)
        self._preview = node.create_publisher(Image, "plan_preview", qos.LATCHED)
        self._enface: OccupancyGrid | None = None
        self._shown: _Shown | None = None
        self._work = LatestWork(node, "plan view", failed)
        # Due at once, and yet after the callback of this group that starts it.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._start = node.create_timer(0.0, self._begin, callback_group=planning, clock=steady, autostart=False)
        group = MutuallyExclusiveCallbackGroup()
        node.create_subscription(OccupancyGrid, "enface", self._on_enface, qos.LATCHED, callback_group=group)

    def show(self, received: ReceivedField, plan: Plan, ee2base: NDArray[np.float64] | None) -> None:
        """Show a plan in place of the last one; returns at once."""
        self._ask(_Shown(received, plan, ee2base))

    def clear(self, received: ReceivedField) -> None:
        """Show that there is no plan on the new field; returns at once."""
        self._ask(_Shown(received, None, None))

    def close(self) -> None:
        """Show nothing more."""
        self._work.close()

    def _on_enface(self, message: OccupancyGrid) -> None:
        self._enface = message
        shown = self._shown
        if shown is not None and shown.received.stamp_ns == conversions.stamp_to_ns(message.header.stamp):
            self._start.reset()  # and not asked for: another thread may have withdrawn meanwhile what was shown

    def _ask(self, shown: _Shown) -> None:
        self._shown = shown
        self._start.reset()

    def _begin(self) -> None:
        self._start.cancel()
        shown = self._shown
        if shown is not None:
            self._work.ask(lambda look: self._publish(shown, look))

    def _publish(self, shown: _Shown, look: Callable[[], None]) -> None:
        plan, received = shown.plan, shown.received
        poses = np.empty((0, 4, 4)) if plan is None else plan.waypoints_ee
        frame, ee2frame = self._calibration.ee_frame, np.eye(4)
        if shown.ee2base is not None:
            frame, ee2frame = self._calibration.base_frame, shown.ee2base
        self._path.publish(conversions.encode_path(ee2frame @ poses, received.stamp_ns, frame))
        pieces = PlanPieces(np.empty((0, 2, 3)), np.empty((0, 4)), np.empty((0, 3)))
        if plan is not None:
            pieces = plan_pieces(plan)
        look()
        self._markers.publish(
            _markers(pieces, ee2frame @ self._calibration.oct2ee, received.field.geometry, received.stamp_ns, frame)
        )
        look()
        words = _WORDS_NONE if plan is None else _words(plan)
        pixels = draw_preview(pieces, received.field.geometry, self._view(received), words)
        self._preview.publish(conversions.to_colour_image(pixels, received.stamp_ns, received.frame))

    def _view(self, received: ReceivedField) -> conversions.GridView | None:
        grid = self._enface
        if grid is None or conversions.stamp_to_ns(grid.header.stamp) != received.stamp_ns:
            return None
        try:
            return conversions.grid_to_view(grid)
        except OctnError as error:
            self._failed(f"enface ignored: {error}")
            return None


def _markers(
    pieces: PlanPieces, oct2frame: NDArray[np.float64], geometry: VolumeGeometry, stamp_ns: int, frame: str
) -> MarkerArray:
    if not len(pieces.pieces_m) and not len(pieces.given_up_m):
        return conversions.to_marker_array([], stamp_ns, frame)

    def moved(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(points_m @ oct2frame[:3, :3].T + oct2frame[:3, 3])

    width_m = math.hypot(*geometry.extent_m[:2]) / 400
    markers = [conversions.line_marker("path", moved(pieces.pieces_m), pieces.colours, width_m)]
    if len(pieces.given_up_m):
        markers.append(conversions.dot_marker("given_up", moved(pieces.given_up_m), GIVEN_UP_COLOUR, 3 * width_m))
    return conversions.to_marker_array(markers, stamp_ns, frame)


def _words(plan: Plan) -> tuple[str, str]:
    return (
        f"{len(plan.segment)} waypoints in {int(plan.segment[-1]) + 1} segments, {plan.given_up} of {plan.requested} "
        f"given up (red), hit rate {plan.hit_rate:.1%}; yellow to green: confidence, grey: laser off",
        f"{plan.field_kind} field {plan.field_hash} of the scan at {plan.stamp_ns * 1e-9:.3f} s",
    )
