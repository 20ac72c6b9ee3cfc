"""The part of a node that knows names: its own, those of topics, and what is in the graph."""

from __future__ import annotations

import re
from collections.abc import Callable

from octn_ros.embedded import wire
from octn_ros.embedded.arguments import Arguments
from octn_ros.embedded.errors import needs_ros2
from octn_ros.embedded.transport import Bus

from . import exceptions

_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NAMESPACE = re.compile(r"/|(/[A-Za-z_]\w*)+", re.ASCII)
_TOPIC = re.compile(r"(~|/|~/)?([A-Za-z_]\w*)?(/[A-Za-z_]\w*)*", re.ASCII)


class NodeGraph:
    """Expands and remaps names and counts what is in the graph. Safe to use from any thread.

    Names of nodes and topics in other processes appear a moment after these are made: wait for them.
    """

    def __init__(self, name: str, namespace: str | None, arguments: Arguments, bus: Bus) -> None:
        self._name = arguments.renamed("__node", name) or name
        self._namespace = "/" + (arguments.renamed("__ns", name) or namespace or "").strip("/")
        self._arguments, self._bus = arguments, bus
        if not _NAME.fullmatch(self._name):
            raise exceptions.InvalidNodeNameException(self._name, "must be alphanumerics or underscores", 0)
        if not _NAMESPACE.fullmatch(self._namespace):
            raise exceptions.InvalidNamespaceException(self._namespace, "must be names separated by slashes", 0)

    def get_name(self) -> str:
        """Return the node's name."""
        return self._name

    def get_namespace(self) -> str:
        """Return the node's namespace, which begins with a slash."""
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        """Return namespace and name."""
        return f"{self._namespace.rstrip('/')}/{self._name}"

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """Return the full name of a topic, remapped unless `only_expand`.

        Raises:
            InvalidTopicNameException: ROS does not allow the name.
        """
        return self._resolve(topic, only_expand, exceptions.InvalidTopicNameException)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """Return the full name of a service, remapped unless `only_expand`.

        Raises:
            InvalidServiceNameException: ROS does not allow the name.
        """
        return self._resolve(service, only_expand, exceptions.InvalidServiceNameException)

    def _resolve(self, name: str, only_expand: bool, error: Callable[[str, str, int], Exception]) -> str:
        if "{" in name:
            raise needs_ros2(f"a substitution in a name, '{name}',")
        if not name or name.endswith("/") or not _TOPIC.fullmatch(name):
            raise error(name, "must be names separated by slashes", 0)
        full = self._expand(name)
        for node, left, right in [] if only_expand else self._arguments.remaps:
            if node in ("", self._name) and not left.startswith("__") and self._expand(left) == full:
                return self._expand(right)
        return full

    def _expand(self, name: str) -> str:
        if name.startswith("~"):
            return f"{self.get_fully_qualified_name()}/{name[1:].lstrip('/')}".rstrip("/")
        return name if name.startswith("/") else f"{self._namespace.rstrip('/')}/{name}"

    def _count(self, kind: str, name: str) -> int:
        return len(self._bus.graph.entities(kind, name))

    def count_publishers(self, topic_name: str) -> int:
        """Return how many publishers of a topic are known."""
        return self._count(wire.PUBLISHER, self.resolve_topic_name(topic_name))

    def count_subscribers(self, topic_name: str) -> int:
        """Return how many subscriptions to a topic are known."""
        return self._count(wire.SUBSCRIPTION, self.resolve_topic_name(topic_name))

    def wait_for_node(self, fully_qualified_node_name: str, timeout: float) -> bool:
        """Wait for a node up to `timeout` seconds; return whether it is there."""
        return self._bus.graph.wait(lambda: self._count(wire.NODE, fully_qualified_node_name) > 0, timeout)
