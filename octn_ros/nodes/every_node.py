"""All nodes of the package, made one after another to be looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import rclpy
from rclpy.node import Node

from octn_ros.nodes import process
from octn_ros.nodes.planner import Planner
from octn_ros.nodes.query import Query
from octn_ros.nodes.simulator import Simulator
from octn_ros.nodes.trainer import Trainer

NODES: tuple[Callable[..., Node], ...] = (Trainer, Query, Planner, Simulator)


def every_node() -> Iterator[Node]:
    """Yield each node in turn; rclpy must be initialised. Makes each once and ends it before the next."""
    for kind in NODES:
        node = kind()
        try:
            yield node
        finally:
            node.destroy_node()


def print_text(make_text: Callable[[], str]) -> None:
    """Print a file's text that is made from the nodes: the whole of a module that is run as a program."""
    rclpy.init(args=["octn_ros", "--ros-args", "--log-level", "error"])
    print(make_text(), end="")
    rclpy.try_shutdown()
    process.leave_workers_behind()
