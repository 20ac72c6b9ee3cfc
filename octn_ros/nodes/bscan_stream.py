"""C-scans from the topics of a scanner: B-scans and their poses, from an arm that held still."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Image

from octn_ros.errors import VolumeError, in_words
from octn_ros.nodes import conversions, qos
from octn_ros.nodes.bscan_pairs import BScanPairs
from octn_ros.nodes.pose_history import PoseHistory
from octn_ros.nodes.trainer_config import TrainerConfig
from octn_ros.volume import OCT_FRAME, Volume
from octn_ros.volume.assembly import CScanAssembler

_LOOK_PERIOD_S = 0.05  # how often it is looked whether what is awaited has come
_SAME_REASON_NS = 1_000_000_000
_VOXEL_BYTES = 4  # of the largest type


class BScanStream:
    """Subscribes to `bscan` and `bscan_pose` and hands complete C-scans on.

    A complete C-scan waits for the first `ee_pose` after it, for `largest_pose_gap_s` at most, and only if there are
    poses of its time at all: whether the arm moved is known then. It waits by a steady clock, as simulated time may
    stand; B-scans are waited for by the node's, as their scanner may stand with it. One callback group for all of it,
    so nothing here runs twice at a time.

    Args:
        node: the node that listens.
        config: asked for the present settings at every B-scan.
        poses: where the end effector was.
        complete: called with each C-scan.
        refused: called with the reason why a C-scan was dropped; the same reason once a second at most.
        doubted: told, once until a scan has poses again, that a C-scan has none although `ee_pose` has been heard.
    """

    def __init__(
        self,
        node: Node,
        config: Callable[[], TrainerConfig],
        poses: PoseHistory,
        complete: Callable[[Volume], object],
        refused: Callable[[str], None],
        doubted: Callable[[str], None],
    ) -> None:
        self._node, self._config, self._poses = node, config, poses
        self._complete, self._refused, self._doubted = complete, refused, doubted
        self._in_doubt = False
        now = config()
        self._pairs = BScanPairs(_VOXEL_BYTES * now.largest_scan_voxels)
        self._assembler: CScanAssembler | None = None
        self._assembled_with: tuple[object, ...] = ()
        self._unproven: tuple[Volume, int, int] | None = None  # C-scan, its last stamp, when it was complete (steady)
        self._heard_ns = 0
        self._last_drop = "", 0
        self.refusals = 0
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        group = MutuallyExclusiveCallbackGroup()
        profile = qos.scan_profile(now.bscan_count, now.bscan_reliability)
        node.create_subscription(Image, "bscan", self._on_image, profile, callback_group=group)
        node.create_subscription(PoseStamped, "bscan_pose", self._on_pose, profile, callback_group=group)
        self._look_timer = node.create_timer(_LOOK_PERIOD_S, self._look, callback_group=group, clock=self._steady)
        self._look_timer.cancel()

    @property
    def received(self) -> int:
        """B-scans of the C-scan that is being assembled."""
        return self._assembler.received if self._assembler else 0

    @property
    def state(self) -> str:
        """What is done: "scanning", "waiting for the arm", or nothing: ""."""
        if self._unproven is not None:
            return "waiting for the arm"
        return "scanning" if self.received else ""

    def _on_image(self, message: Image) -> None:
        self._guarded(lambda: self._on_pair(self._pairs.add_image(message)))

    def _on_pose(self, message: PoseStamped) -> None:
        self._guarded(lambda: self._on_pair(self._pairs.add_pose(message)))

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception as error:  # also a fault of ours, or memory that ran out: the node lives on
            self._drop(f"C-scan dropped: {in_words(error)}")
        # Whatever was dropped or not, there may be something to look for. A timer that runs is left to run.
        if self.state and self._look_timer.is_canceled():
            self._look_timer.reset()

    def _drop(self, reason: str) -> None:
        self.refusals += 1
        now_ns = self._now_ns()
        if reason != self._last_drop[0] or now_ns - self._last_drop[1] > _SAME_REASON_NS:
            self._last_drop = reason, now_ns
            self._refused(reason)

    def _on_pair(self, pair: tuple[Image, PoseStamped] | None) -> None:
        if pair is None:
            return
        image, pose = pair
        self._heard_ns = self._now_ns()
        assembler = self._assembling()
        if pose.header.frame_id != OCT_FRAME:
            raise VolumeError(f"expected bscan_pose in the frame {OCT_FRAME}, got {pose.header.frame_id!r}")
        image2oct = conversions.pose_to_matrix(pose.pose)
        stamp_ns = conversions.stamp_to_ns(image.header.stamp)
        volume = assembler.add(conversions.image_to_array(image), image2oct, stamp_ns, _form(image))
        if volume is not None:
            self._guarded(self._settle)  # one C-scan on the heels of another
            self._unproven = volume, assembler.last_stamp_ns, self._steady.now().nanoseconds
            if self._poses.nearest(stamp_ns, self._config().largest_pose_gap_s) is None or self._proven():
                self._settle()

    def _assembling(self) -> CScanAssembler:
        config = self._config()
        if config.bscan_count < 2 or config.spacing_m is None:
            raise VolumeError(
                "expected the parameters bscan_count and spacing_um (bscan or 0, axial, lateral) to state what the "
                f"scanner sends, got bscan_count {config.bscan_count} and spacing_um {config.spacing_um}; set both"
            )
        described = config.bscan_count, config.spacing_m, config.scale
        if self._assembler is None or described != self._assembled_with:
            given_up = self._assembler.give_up() if self._assembler else None
            self._assembler = CScanAssembler(
                *described, largest_voxels=config.largest_scan_voxels, room=conversions.voxel_room
            )
            self._assembled_with = described
            if given_up:
                self._drop(f"C-scan dropped: the parameters that describe it have changed; {given_up}")
        return self._assembler

    def _look(self) -> None:
        """See to what a callback cannot wait for: the poses after a C-scan, and B-scans that do not come."""
        config, now_ns = self._config(), self._now_ns()
        if self._unproven is not None:
            waited_s = (self._steady.now().nanoseconds - self._unproven[2]) * 1e-9
            if self._proven() or waited_s > config.largest_pose_gap_s:
                self._guarded(self._settle)
        if self._assembler and self.received and (now_ns - self._heard_ns) * 1e-9 > config.longest_bscan_wait_s:
            self._drop(f"C-scan dropped after {config.longest_bscan_wait_s:g} s: {self._assembler.give_up()}")
        if not self.received and self._unproven is None:
            self._look_timer.cancel()

    def _proven(self) -> bool:
        return self._unproven is not None and self._poses.heard_until(self._unproven[1])

    def _settle(self) -> None:
        """Hand the C-scan on that waits for its poses, unless they say that the arm moved."""
        if self._unproven is None:
            return
        volume, end_ns, _ = self._unproven
        self._unproven = None
        config = self._config()
        motion = self._poses.motion(volume.stamp_ns, end_ns, config.largest_pose_gap_s)
        if motion is None and len(self._poses) and not self._in_doubt:
            self._doubted(
                f"nobody knows whether the arm moved during the C-scan at {volume.stamp_ns} ns: no ee_pose within "
                f"{config.largest_pose_gap_s:g} s of it (parameter largest_pose_gap_s), though it was heard before; do "
                "arm and scanner have the same clock?"
            )
        self._in_doubt = motion is None and len(self._poses) > 0
        if motion is not None and motion.translation_m > config.largest_scan_motion_m:
            raise VolumeError(
                f"expected an arm that holds still within {config.largest_scan_motion_m * 1e6:g} um during a C-scan, "
                f"its ee_pose moved by {motion.translation_m * 1e6:.1f} um; scan again"
            )
        if motion is not None and motion.rotation_rad > config.largest_scan_rotation_rad:
            raise VolumeError(
                f"expected an arm that holds still within {config.largest_scan_rotation_rad * 1e3:g} mrad during a "
                f"C-scan, its ee_pose turned by {motion.rotation_rad * 1e3:.2f} mrad; scan again"
            )
        self._complete(volume)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)


def _form(image: Image) -> str:
    order = "big" if image.is_bigendian else "little"
    return f"{image.encoding}, {order}-endian, rows of {image.step} bytes, in the frame {image.header.frame_id!r}"
