"""A recording of the graph as one MCAP file, which Foxglove opens by itself: schemas and frames lie in it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import octn_ros.nodes  # noqa: F401 - makes rclpy importable where ROS 2 is missing

# isort: split
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile

from octn_ros.errors import OctnError
from octn_ros.nodes.background import BackgroundSpin
from octn_ros.nodes.client import wait_graph
from octn_ros.nodes.interfaces import type_name

if TYPE_CHECKING:
    from mcap.writer import Writer

LEAST_DEPTH = 10  # of a queue: a latched topic may speak twice while a C-scan is being written
MATCH_S = 120.0
QUIET_S = 0.2  # nothing more comes once the publishers are gone and this long has passed
DRAIN_S = 30.0  # at most, for what waits in the queues at the end


class RecordingError(OctnError):
    """The recording cannot be made."""


class Recording:
    """Writes every message of some nodes' topics to a file, as it came over the wire, from now on until `close`.

    What was latched before is written too. The file grows as the messages come: in memory there are the queues, each as
    deep as its publisher's, and one chunk of a megabyte. Message times in the file are when they were heard; stamps are
    in the messages. It has a thread of its own; `close` may be called from any thread.

    Args:
        nodes: whose topics are recorded; they exist, in this process.
        path: of the file; one that lies there is replaced.

    Raises:
        RecordingError: a package is missing, or the file cannot be made.
        TimeoutError: the topics were not heard.
    """

    def __init__(self, nodes: Iterable[Node], path: Path) -> None:
        self._path = path
        self._fault: OSError | None = None
        self._written = 0
        topics = {topic.topic_name: topic for node in nodes for topic in node.publishers}
        schemas = {name: _definition(type_name(topic.msg_type)) for name, topic in topics.items()}
        self._writer = self._open()
        self._node = Node("recorder")
        heard = []
        for name, topic in topics.items():
            kind = type_name(topic.msg_type)
            schema = self._writer.register_schema(kind, "ros2msg", schemas[name].encode())
            channel = self._writer.register_channel(name, "cdr", schema, _offered(topic.qos_profile))
            write, profile = partial(self._write, channel), _profile(topic.qos_profile)
            heard.append(self._node.create_subscription(topic.msg_type, name, write, profile, raw=True))
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._spin = BackgroundSpin(self._executor, "recorder")
        wait_graph(lambda: all(topic.get_publisher_count() for topic in heard), MATCH_S, "recorder: not all topics")

    def close(self) -> None:
        """Write what still waits, and the end of the file; call it once the publishers are gone.

        Raises:
            RecordingError: the file could not be written, its disk was full for instance.
        """
        self._spin.stop()
        end = time.monotonic() + DRAIN_S
        last, written = time.monotonic(), self._written
        while time.monotonic() < min(end, last + QUIET_S):
            self._executor.spin_once(timeout_sec=QUIET_S)
            if self._written != written:
                last, written = time.monotonic(), self._written
        self._executor.shutdown()
        self._node.destroy_node()
        for end_file in (self._writer.finish, self._file.close):
            try:
                end_file()
            except OSError as error:
                self._fault = self._fault or error
        if self._fault is not None:
            raise RecordingError(
                f"{self._path}: cannot write the recording: {self._fault.strerror or self._fault}; it ends after "
                f"{self._written} messages"
            ) from self._fault

    def _open(self) -> Writer:
        from mcap.writer import Writer

        try:
            self._file = self._path.open("wb")
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot write the recording: {error.strerror or error}") from error
        writer = Writer(self._file)
        writer.start(profile="ros2", library="octn_ros")
        return writer

    def _write(self, channel: int, data: bytes) -> None:
        if self._fault is not None:
            return
        now_ns = int(self._node.get_clock().now().nanoseconds)
        try:
            self._writer.add_message(channel, now_ns, data, now_ns)
        except OSError as error:  # the demo goes on without it, and says so at the end
            self._fault = error
            return
        self._written += 1


def _definition(kind: str) -> str:
    """Return the text of a message type and of all types in it, as ROS 2 recordings have it."""
    try:
        import mcap.writer  # noqa: F401 - asked for beside it, so that one message names both
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RecordingError(
            f"a recording needs the package {error.name}: pip install 'octn_ros[record]', or mcap and rosbags by name"
        ) from error
    return str(get_typestore(Stores.ROS2_JAZZY).generate_msgdef(kind, ros_version=2)[0])


def _offered(profile: QoSProfile) -> dict[str, str]:
    """Return what `ros2 bag play` offers a topic with: played volatile, a latched one would reach no latched reader."""
    unspecified = {"sec": 0, "nsec": 0}
    offer = {
        "history": int(profile.history),
        "depth": profile.depth,
        "reliability": int(profile.reliability),
        "durability": int(profile.durability),
        "deadline": unspecified,
        "lifespan": unspecified,
        "liveliness": 1,  # automatic
        "liveliness_lease_duration": unspecified,
        "avoid_ros_namespace_conventions": False,
    }
    return {"offered_qos_profiles": json.dumps([offer])}  # JSON is YAML, which rosbag2 reads


def _profile(offered: QoSProfile) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(offered.depth, LEAST_DEPTH),
        reliability=offered.reliability,
        durability=offered.durability,
    )
