"""Lines, dots and their colours as markers for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from octn_ros.nodes.conversions.headers import header

Colour = tuple[float, float, float, float]


def line_marker(namespace: str, pieces_m: NDArray[np.float64], colours: NDArray[np.float64], width_m: float) -> Marker:
    """Return straight pieces [N, 2, 3] as one marker.

    Args:
        namespace: what they are called.
        pieces_m: both ends of each.
        colours: (red, green, blue, alpha) of each [N, 4], 0 to 1.
        width_m: their width.
    """
    marker = _marker(namespace, Marker.LINE_LIST)
    marker.scale.x = float(width_m)
    marker.points = _points(pieces_m.reshape(-1, 3))
    marker.colors = [
        colour
        for r, g, b, a in colours.tolist()
        for colour in [ColorRGBA(r=r, g=g, b=b, a=a)] * 2  # the same at both ends
    ]
    return marker


def dot_marker(namespace: str, places_m: NDArray[np.float64], colour: Colour, size_m: float) -> Marker:
    """Return balls of one colour at places [N, 3] as one marker."""
    marker = _marker(namespace, Marker.SPHERE_LIST)
    marker.scale.x = marker.scale.y = marker.scale.z = float(size_m)
    marker.color = ColorRGBA(r=colour[0], g=colour[1], b=colour[2], a=colour[3])
    marker.points = _points(places_m)
    return marker


def to_marker_array(markers: Sequence[Marker], stamp_ns: int, frame: str) -> MarkerArray:
    """Return markers in `frame` in place of all that were there before; with none of them, the old ones go."""
    clear = Marker(action=Marker.DELETEALL)
    head = header(stamp_ns, frame)
    for marker in (clear, *markers):
        marker.header = head
    return MarkerArray(markers=[clear, *markers])


def _marker(namespace: str, kind: int) -> Marker:
    marker = Marker(ns=namespace, id=0, type=kind, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    return marker


def _points(places_m: NDArray[np.float64]) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in places_m.tolist()]
