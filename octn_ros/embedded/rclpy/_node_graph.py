"""The part of a node that knows names: its own, those of topics, and what is in the graph."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from octn_ros.embedded import definitions, wire

from .exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidServiceNameException,
    InvalidTopicNameException,
)

if TYPE_CHECKING:
    from octn_ros.embedded.arguments import Arguments
    from octn_ros.embedded.transport import Bus

_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NAMESPACE = re.compile(r"/|(/[A-Za-z_]\w*)+", re.ASCII)
_TOPIC = re.compile(r"(~|/|~/)?([A-Za-z_]\w*)?(/[A-Za-z_]\w*)*", re.ASCII)


class NodeGraph:
    """Expands and remaps names and counts what is in the graph. Safe to use from any thread.

    Names of nodes and topics in other processes appear a moment after these are made: wait for them.
    """

    def __init__(self, name: str, namespace: str | None, arguments: list[Arguments], bus: Bus) -> None:
        renamed = [a.renamed("__node", name) for a in arguments]
        moved = [a.renamed("__ns", name) for a in arguments]
        self._name = next((n for n in renamed if n is not None), name)
        self._namespace = "/" + next((n for n in moved if n is not None), namespace or "").strip("/")
        self._arguments, self._bus = arguments, bus
        if not _NAME.fullmatch(self._name):
            raise InvalidNodeNameException(self._name, "must be alphanumerics or underscores", 0)
        if not _NAMESPACE.fullmatch(self._namespace):
            raise InvalidNamespaceException(self._namespace, "must be names separated by slashes", 0)

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
        if not self._is_allowed(topic):
            raise InvalidTopicNameException(topic, "topic name is invalid", 0)
        return self._resolve(topic, only_expand)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """Return the full name of a service, remapped unless `only_expand`.

        Raises:
            InvalidServiceNameException: ROS does not allow the name.
        """
        if not self._is_allowed(service):
            raise InvalidServiceNameException(service, "service name is invalid", 0)
        return self._resolve(service, only_expand)

    def _substitute(self, name: str) -> str:
        for key, value in (("node", self._name), ("ns", self._namespace), ("namespace", self._namespace)):
            name = name.replace(f"{{{key}}}", value)
        return name

    def _is_allowed(self, name: str) -> bool:
        plain = self._substitute(name)
        return bool(name) and not plain.endswith("/") and _TOPIC.fullmatch(plain) is not None

    def _resolve(self, name: str, only_expand: bool) -> str:
        full = self._expand(name)
        rules = [] if only_expand else [r for a in self._arguments for r in a.remaps]
        for node, left, right in rules:
            if node in ("", self._name) and not left.startswith("__") and self._expand(left) == full:
                return self._expand(right)
        return full

    def _expand(self, name: str) -> str:
        name = self._substitute(name)
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

    def count_services(self, service_name: str) -> int:
        """Return how many servers of a service are known."""
        return self._count(wire.SERVICE, self.resolve_service_name(service_name))

    def count_clients(self, service_name: str) -> int:
        """Return how many clients of a service are known."""
        return self._count(wire.CLIENT, self.resolve_service_name(service_name))

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return name and namespace of all nodes that are known."""
        parts = [t.node.rpartition("/") for t in self._bus.graph.entities(wire.NODE)]
        return [(name, namespace or "/") for namespace, _, name in parts]

    def get_node_names(self) -> list[str]:
        """Return the names of all nodes that are known."""
        return [name for name, _ in self.get_node_names_and_namespaces()]

    def get_fully_qualified_node_names(self) -> list[str]:
        """Return namespaces and names of all nodes that are known."""
        return [t.node for t in self._bus.graph.entities(wire.NODE)]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        """Return all topics that are known, each with its types; names are never mangled here."""
        return self._names_and_types(wire.PUBLISHER, wire.SUBSCRIPTION)

    def get_service_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return all services that are known, each with its types."""
        return self._names_and_types(wire.SERVICE)

    def _names_and_types(self, *kinds: str) -> list[tuple[str, list[str]]]:
        found: dict[str, set[str]] = {}
        for token in (t for kind in kinds for t in self._bus.graph.entities(kind)):
            found.setdefault(token.name, set()).add(definitions.ros_name(token.type_name))
        return [(name, sorted(types)) for name, types in sorted(found.items())]

    def wait_for_node(self, fully_qualified_node_name: str, timeout: float) -> bool:
        """Wait for a node up to `timeout` seconds; return whether it is there."""
        return self._bus.graph.wait(lambda: self._count(wire.NODE, fully_qualified_node_name) > 0, timeout)
