"""The scan that the graph knows: its field, its en-face view and its pose, latched, and the newest field on disk."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage

from octn_ros.field import FieldDescription, field_hash
from octn_ros.nodes import conversions, qos
from octn_ros.nodes.field_store import FieldStore, KeptField
from octn_ros.nodes.pose_history import PoseHistory, StampedPose
from octn_ros.query import enface
from octn_ros.volume import Volume


@dataclass
class ScanPlace:
    """Where the end effector was at one scan, as far as it has been told.

    Attributes:
        stamp_ns: acquisition time of the scan.
        pose: the pose nearest to it so far, None if there is none.
        settled: whether no other pose counts any more.
    """

    stamp_ns: int
    pose: StampedPose | None = None
    settled: bool = False

    def take(self, pose: StampedPose | None, largest_gap_s: float) -> bool:
        """Take a pose if it is the nearest so far, and near enough; return whether."""
        if pose is None or self.settled:
            return False
        gap_ns = abs(pose.stamp_ns - self.stamp_ns)
        if self.pose is not None and gap_ns >= abs(self.pose.stamp_ns - self.stamp_ns):
            return False
        if gap_ns > largest_gap_s * 1e9:
            return False
        self.pose = pose
        return True


@dataclass
class NewScan:
    """A C-scan with everything that is published of it at once, made before anything is published.

    Attributes:
        volume: the C-scan.
        view: its en-face view [bscan, lateral].
        grid: the view as a message.
        field: the message of the field through its voxels, which lie in the message's own memory.
        hash: identity of that field.
        place: where the end effector was.
        shown: whether all this has been published.
    """

    volume: Volume
    view: NDArray[np.float32]
    grid: OccupancyGrid
    field: CompressedImage
    hash: str
    place: ScanPlace
    shown: bool = False

    @classmethod
    def of(cls, volume: Volume) -> NewScan:
        """Make ready what is published of a C-scan."""
        view = enface(volume)
        volume, field, identity = conversions.with_field_message(volume)
        grid = conversions.to_grid(view, volume.geometry, volume.stamp_ns)
        return cls(volume, view, grid, field, identity, ScanPlace(volume.stamp_ns))


@dataclass(frozen=True)
class KnownField:
    """What is known of the field that is published.

    Attributes:
        stamp_ns: acquisition time of its scan.
        kind: interpolated or neural.
        hash: identity of its bytes.
    """

    stamp_ns: int
    kind: str
    hash: str


class PresentScan:
    """Publishes `field`, `enface` and `scan_ee_pose`, latched, of one scan at a time; safe from any thread.

    Args:
        node: the node that publishes.
        poses: where the end effector was.
        largest_gap_s: asked how far in time a pose may lie from the scan's stamp.
        store: where fitted fields are kept, None if nowhere.
    """

    def __init__(
        self, node: Node, poses: PoseHistory, largest_gap_s: Callable[[], float], store: FieldStore | None
    ) -> None:
        self._poses, self._largest_gap_s, self._store = poses, largest_gap_s, store
        self._field = node.create_publisher(CompressedImage, "field", qos.LATCHED)
        self._scan_ee_pose = node.create_publisher(PoseStamped, "scan_ee_pose", qos.LATCHED)
        self._enface = node.create_publisher(OccupancyGrid, "enface", qos.LATCHED)
        self._lock = threading.RLock()  # held from the question which scan is the present one to the answer
        self._writing = threading.Lock()
        self._scan: NewScan | None = None
        self._place: ScanPlace | None = None
        self._expected: ScanPlace | None = None
        self._known: KnownField | None = None
        self._kept: KeptField | None = None

    @property
    def known(self) -> KnownField | None:
        """The field that is published, None before the first."""
        return self._known

    def is_of(self, scan: NewScan) -> bool:
        """Return whether this C-scan is the present one."""
        return self._scan is scan

    def expect(self, scan: NewScan) -> None:
        """Look up where the end effector was at a C-scan that has come; poses that come count too, however long it is
        until the C-scan is shown. Of those that wait only the last one that was expected will be.
        """
        with self._lock:
            self._expected = scan.place
            largest_gap_s = self._largest_gap_s()
            scan.place.take(self._poses.nearest(scan.place.stamp_ns, largest_gap_s), largest_gap_s)

    def show(self, scan: NewScan) -> None:
        """Make a C-scan the present one and publish what is known of it at once, unless that has been done."""
        with self._lock:
            if scan.shown:
                return
            scan.shown = True
            self._scan, self._place, self._kept = scan, scan.place, None
            self._enface.publish(scan.grid)
            self._publish(scan.field, KnownField(scan.volume.stamp_ns, "interpolated", scan.hash))

    def show_fitted(self, scan: NewScan, data: bytes) -> bool:
        """Publish the field fitted to a C-scan and keep it on disk; False if the C-scan is no longer the present one.

        Raises:
            CheckpointError: it is published, and cannot be kept.
        """
        stamp_ns, frame = scan.volume.stamp_ns, scan.volume.geometry.frame
        message, identity = conversions.encode_field((data,), stamp_ns, frame), field_hash(data)
        with self._lock:
            if self._scan is not scan:
                return False
            self._publish(message, KnownField(stamp_ns, "neural", identity))
            self._kept = kept = KeptField(data, identity, stamp_ns, frame, scan.view, scan.place.pose)
        self._keep(kept)
        return True

    def show_kept(self, kept: KeptField, description: FieldDescription) -> None:
        """Publish a field from the disk, which its description says more of, of the scan that it was fitted to then."""
        with self._lock:
            self._place, self._kept = ScanPlace(kept.stamp_ns, kept.pose), kept
            self._enface.publish(conversions.to_grid(kept.enface, description.geometry, kept.stamp_ns))
            message = conversions.encode_field((kept.data,), kept.stamp_ns, kept.frame)
            self._publish(message, KnownField(kept.stamp_ns, description.kind, kept.hash))

    def see_pose(self, pose: StampedPose) -> None:
        """Take a pose of the end effector: it may be nearer to the scan than those that came before, or to the one that
        waits.

        Raises:
            CheckpointError: it is published, and cannot be kept.
        """
        largest_gap_s = self._largest_gap_s()
        with self._lock:
            if self._expected is not None and self._expected is not self._place:
                self._expected.take(pose, largest_gap_s)
            if self._place is None or not self._place.take(pose, largest_gap_s):
                return
            self._publish_pose()
            if self._kept is None:
                return
            self._kept = kept = dataclasses.replace(self._kept, pose=pose)
        self._keep(kept)

    def settle(self) -> None:
        """Take no other pose for the scans so far: the clock was set back, and those that come are of another time."""
        with self._lock:
            for place in filter(None, (self._place, self._expected)):
                place.settled = True

    def _keep(self, kept: KeptField) -> None:
        """Write a field to the disk unless it is no longer the one to keep; poses go on coming meanwhile."""
        if self._store is None:
            return
        with self._writing:
            if self._kept is kept:
                self._store.keep(kept)

    def _publish(self, message: CompressedImage | bytes, known: KnownField) -> None:
        # The pose goes first, so that whoever gets the field can place it.
        self._publish_pose()
        self._field.publish(message)
        self._known = known

    def _publish_pose(self) -> None:
        place = self._place
        if place is not None and place.pose is not None:
            message = conversions.matrix_to_pose_stamped(place.pose.ee2base, place.stamp_ns, place.pose.frame)
            self._scan_ee_pose.publish(message)
