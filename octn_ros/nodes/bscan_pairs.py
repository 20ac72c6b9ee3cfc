"""B-scan images and their poses, brought together by equal acquisition stamps."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from octn_ros.errors import VolumeError
from octn_ros.nodes.conversions import stamp_to_ns

_MOST = 100_000  # of each that wait for the other: more than any C-scan has B-scans


class BScanPairs:
    """Joins two topics whose messages come in order each, but not together. For one thread at a time.

    Args:
        largest_bytes: of the images that may wait for their poses.
    """

    def __init__(self, largest_bytes: int) -> None:
        self._largest_bytes = largest_bytes
        self._images: dict[int, Image] = {}
        self._bytes = 0  # of all of them
        self._poses: dict[int, PoseStamped] = {}

    def add_image(self, image: Image) -> tuple[Image, PoseStamped] | None:
        """Take an image; return it with its pose if that is here.

        Raises:
            VolumeError: so many images wait for poses that memory would run out; all of them are forgotten.
        """
        stamp_ns = stamp_to_ns(image.header.stamp)
        replaced = self._images.pop(stamp_ns, None)
        self._images[stamp_ns] = image
        self._bytes += len(image.data) - (0 if replaced is None else len(replaced.data))
        pair = self._join(stamp_ns)
        if self._bytes > self._largest_bytes or len(self._images) > _MOST:
            count, waiting = len(self._images), self._bytes
            self._images, self._bytes = {}, 0
            raise VolumeError(
                f"expected a bscan_pose of equal stamp for every image on bscan, got none for {count} images of "
                f"{waiting:,} bytes; they are dropped. Is bscan_pose published, with the stamps of the images?"
            )
        return pair

    def add_pose(self, pose: PoseStamped) -> tuple[Image, PoseStamped] | None:
        """Take a pose; return it with its image if that is here."""
        self._poses[stamp_to_ns(pose.header.stamp)] = pose
        if len(self._poses) > _MOST:
            del self._poses[next(iter(self._poses))]
        return self._join(stamp_to_ns(pose.header.stamp))

    def _join(self, stamp_ns: int) -> tuple[Image, PoseStamped] | None:
        if stamp_ns not in self._images or stamp_ns not in self._poses:
            return None
        pair = self._images[stamp_ns], self._poses[stamp_ns]
        # Both topics are ordered: what is older than a complete pair has lost its partner for good.
        self._images = {stamp: image for stamp, image in self._images.items() if stamp > stamp_ns}
        self._bytes = sum(len(image.data) for image in self._images.values())
        self._poses = {stamp: pose for stamp, pose in self._poses.items() if stamp > stamp_ns}
        return pair
