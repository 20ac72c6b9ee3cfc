"""B-scan images and their poses, brought together by equal acquisition stamps."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from octn_ros.nodes.conversions import stamp_to_ns


class BScanPairs:
    """Joins two topics whose messages come in order each, but not together. For one thread at a time."""

    def __init__(self) -> None:
        self._images: dict[int, Image] = {}
        self._poses: dict[int, PoseStamped] = {}

    def add_image(self, image: Image) -> tuple[Image, PoseStamped] | None:
        """Take an image; return it with its pose if that is here."""
        self._images[stamp_to_ns(image.header.stamp)] = image
        return self._join(stamp_to_ns(image.header.stamp))

    def add_pose(self, pose: PoseStamped) -> tuple[Image, PoseStamped] | None:
        """Take a pose; return it with its image if that is here."""
        self._poses[stamp_to_ns(pose.header.stamp)] = pose
        return self._join(stamp_to_ns(pose.header.stamp))

    def _join(self, stamp_ns: int) -> tuple[Image, PoseStamped] | None:
        if stamp_ns not in self._images or stamp_ns not in self._poses:
            return None
        pair = self._images[stamp_ns], self._poses[stamp_ns]
        # Both topics are ordered: what is older than a complete pair has lost its partner for good.
        self._images = {stamp: image for stamp, image in self._images.items() if stamp > stamp_ns}
        self._poses = {stamp: pose for stamp, pose in self._poses.items() if stamp > stamp_ns}
        return pair
