"""The surface of the present field on the graph, found beside the executor for each new field."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from octn_ros.errors import QueryError
from octn_ros.nodes import conversions, qos
from octn_ros.nodes.field_receiver import ReceivedField
from octn_ros.nodes.latest_work import LatestWork
from octn_ros.query import SurfaceMapConfig, surface_map

COLUMNS = ("x", "y", "z", "intensity", "confidence")
# Points of the A-scans that are searched: some 24 bytes of memory each.
LARGEST_SEARCH = 1 << 26


class SurfacePublisher:
    """Publishes `surface`, latched: the surface of a field over a lattice of A-scans, in the OCT frame.

    Args:
        node: the node that publishes.
        config: returns how the surface is now looked for.
        failed: told why there is no surface of a field.
    """

    def __init__(self, node: Node, config: Callable[[], SurfaceMapConfig], failed: Callable[[str], None]) -> None:
        self._config = config
        self._publisher = node.create_publisher(PointCloud2, "surface", qos.LATCHED)
        self._work = LatestWork(node, "surface", lambda reason: failed(f"no surface of the field: {reason}"))

    def show(self, received: ReceivedField) -> None:
        """Publish the surface of a field in place of the last one; returns at once. From any thread.

        One that cannot be had is withdrawn: an empty cloud.
        """
        self._work.ask(lambda look: self._find(received, look))

    def close(self) -> None:
        """Publish no more."""
        self._work.close()

    def _find(self, received: ReceivedField, look: Callable[[], None]) -> None:
        try:
            rows = self._rows(received)
        except Exception:
            look()  # raises where it was superseded, which is no failure
            self._send(received, np.empty((0, len(COLUMNS))))
            raise
        look()
        self._send(received, rows)

    def _rows(self, received: ReceivedField) -> NDArray[np.float64]:
        config, axials = self._config(), received.field.geometry.shape[1]
        if config.max_ascans * axials > LARGEST_SEARCH:
            raise QueryError(
                f"expected at most {LARGEST_SEARCH // axials:,} A-scans of {axials} voxels (parameter "
                f"surface.max_ascans), got {config.max_ascans:,}"
            )
        found = surface_map(received.field, config)
        x, y = np.meshgrid(found.lateral_m, found.bscan_m)
        return np.column_stack([part.ravel() for part in (x, y, found.depth_m, found.intensity, found.confidence)])

    def _send(self, received: ReceivedField, rows: NDArray[np.float64]) -> None:
        self._publisher.publish(
            conversions.to_cloud(conversions.table(COLUMNS, rows), received.stamp_ns, received.frame)
        )
