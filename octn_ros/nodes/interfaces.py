"""What a node offers to the graph and takes from it, read off the node itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from octn_ros.nodes.every_node import every_node

PUBLISHES, SUBSCRIBES, OFFERS = "publishes", "subscribes", "offers"
# Every node of rclpy has these, whatever its author does.
PARAMETER_SERVICES = (
    "describe_parameters", "get_parameters", "get_parameter_types", "list_parameters", "set_parameters",
    "set_parameters_atomically",
)  # fmt: skip
_OF_RCLPY = {"/parameter_events", "/rosout", "/clock", "~/get_type_description"} | {
    f"~/{name}" for name in PARAMETER_SERVICES
}


@dataclass(frozen=True)
class Interface:
    """One topic or service of one node; immutable.

    Attributes:
        node: the node's name.
        role: PUBLISHES, SUBSCRIBES or OFFERS, the last of a service.
        name: relative to the node's namespace where it lies in it, else from the root.
        type: the interface's name, `sensor_msgs/msg/Image`.
        qos: of a topic; None of a service.
    """

    node: str
    role: str
    name: str
    type: str
    qos: QoSProfile | None

    @property
    def qos_text(self) -> str:
        """The profile in words, empty for a service."""
        if self.qos is None:
            return ""
        reliable = "reliable" if self.qos.reliability == ReliabilityPolicy.RELIABLE else "best effort"
        if self.qos.durability != DurabilityPolicy.TRANSIENT_LOCAL:
            return f"{reliable}, depth {self.qos.depth}"
        return "latched" if self.qos.depth == 1 else f"{reliable}, the last {self.qos.depth} kept for late joiners"


def interfaces_of(node: Node) -> list[Interface]:
    """Return the topics and services of a node but those that every node of rclpy has, in order of role and name."""
    name = node.get_name()
    found = [
        Interface(name, role, _relative(node, topic.topic_name), type_name(topic.msg_type), topic.qos_profile)
        for role, topics in ((PUBLISHES, node.publishers), (SUBSCRIBES, node.subscriptions))
        for topic in topics
    ]
    found += [
        Interface(name, OFFERS, _relative(node, service.service_name), type_name(service.srv_type), None)
        for service in node.services
    ]
    order = (PUBLISHES, SUBSCRIBES, OFFERS)
    return sorted(
        (interface for interface in found if interface.name not in _OF_RCLPY),
        key=lambda interface: (order.index(interface.role), interface.name),
    )


def all_interfaces() -> Iterator[list[Interface]]:
    """Return those of each node in turn; rclpy must be initialised. Makes each node once and ends it again."""
    return (interfaces_of(node) for node in every_node())


def _relative(node: Node, name: str) -> str:
    private = node.get_fully_qualified_name() + "/"
    if name.startswith(private):
        return "~/" + name.removeprefix(private)
    return name.removeprefix(node.get_namespace().rstrip("/") + "/")


def type_name(kind: Any) -> str:
    """Return the name of a message or service class, `sensor_msgs/msg/Image`."""
    package, group, *_ = kind.__module__.split(".")
    return f"{package}/{group}/{kind.__name__}"
