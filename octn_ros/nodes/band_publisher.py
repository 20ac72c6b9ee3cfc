"""The intensity band on the graph: published when asked for, and again when its limits or the field change."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.nodes import conversions, qos
from octn_ros.nodes.field_receiver import FieldReceiver, ReceivedField
from octn_ros.nodes.latest_work import LatestWork
from octn_ros.query import BandQuery, Box, Region, find_band
from octn_ros.settings import check_settings, setting

COLUMNS = ("x", "y", "z", "intensity")


@dataclass(frozen=True)
class BandRegion:
    """Where the band is looked for."""

    shape: str = setting("scan", "where the band is looked for: the whole scan or a box", choices=("scan", "box"))
    low_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "box: corner of the lowest (x, y, z) in the OCT frame", unit="m"
    )
    high_m: tuple[float, float, float] = setting(
        (1e-3, 1e-3, 1e-3), "box: corner of the highest (x, y, z) in the OCT frame", unit="m"
    )

    def __post_init__(self) -> None:
        check_settings(self)
        self.region()

    def region(self) -> Region | None:
        """Return the region, None for the whole scan.

        Raises:
            QueryError: the corners of the box are not in order.
        """
        return Box(self.low_m, self.high_m) if self.shape == "box" else None


class BandPublisher:
    """Publishes `band`, latched: the points of the present field within the present limits.

    May be called from any thread; bands are looked for one after another, so the last one published is that of the
    last limits.

    Args:
        node: the node that publishes.
        wanted: returns the limits and the region as they now are.
        fields: has the present field, or says why there is none.
        failed: told why a band could not be published again.
    """

    def __init__(
        self,
        node: Node,
        wanted: Callable[[], tuple[BandQuery, Region | None]],
        fields: FieldReceiver,
        failed: Callable[[str], None],
    ) -> None:
        self._wanted, self._fields, self._failed = wanted, fields, failed
        self._publisher = node.create_publisher(PointCloud2, "band", qos.LATCHED)
        self._lock = threading.Lock()
        self._asked = False
        self._work = LatestWork(node, "band", failed)

    def answer(self) -> str:
        """Publish the band now, and from now on whenever it changes; return what was found, in words.

        Raises:
            OctnError: there is no field, the region does not touch the scan, or there are too many points.
        """
        with self._lock:
            before, self._asked = self._asked, True  # first, so that a field that comes meanwhile refreshes the band
            try:
                return self._publish(lambda: None)
            except Exception:
                self._asked = before
                raise

    def refresh(self) -> None:
        """Publish the band again if it was ever asked for, beside the caller; of many such calls the last one counts.

        A band that cannot be had any more is withdrawn: an empty cloud.
        """
        if self._asked:
            self._work.ask(self._again)

    def close(self) -> None:
        """Publish no more."""
        self._work.close()

    def _again(self, look: Callable[[], None]) -> None:
        with self._lock:
            if not self._asked:  # the first question was refused meanwhile
                return
            try:
                self._publish(look)
            except Exception:
                look()  # raises where it was superseded, which is no failure
                received = self._fields.current  # which may no longer be good enough for a band
                if received is not None:
                    self._send(received, np.empty((0, len(COLUMNS))))
                raise

    def _publish(self, look: Callable[[], None]) -> str:
        """Find and publish the band; the lock is held. Returns what was found, in words."""
        began = time.perf_counter()
        received = self._fields.required()
        query, region = self._wanted()
        found = find_band(received.field, query, region, progress=lambda _: look())
        self._send(received, np.column_stack([found.points_m, found.intensity]))
        return (
            f"{len(found.intensity):,} points of {found.searched:,} from {query.low:g} to {query.high:g} "
            f"in {time.perf_counter() - began:.2f} s"
        )

    def _send(self, received: ReceivedField, columns: np.ndarray) -> None:
        self._publisher.publish(
            conversions.to_cloud(conversions.table(COLUMNS, columns), received.stamp_ns, received.frame)
        )
