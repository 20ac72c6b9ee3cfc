"""The text of docs/interfaces.md, from the nodes themselves.

Write it again with `python -m octn_ros.nodes.interface_page > docs/interfaces.md`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from octn_ros.errors import ConfigurationError
from octn_ros.nodes.every_node import print_text
from octn_ros.nodes.interface_meanings import MEANINGS
from octn_ros.nodes.interfaces import OFFERS, PUBLISHES, SUBSCRIBES, Interface, all_interfaces

_HEAD = """\
# Interfaces

Every topic and service of every node. Standard types only, so nothing has to be compiled on the caller's side. Names
without a slash in front lie in the nodes' namespace, `/octn` unless told otherwise. Frames, units and times:
[conventions.md](conventions.md); how to connect a scanner and an arm: [connecting.md](connecting.md).

*Latched* is reliable, transient local, depth 1, **on both ends**: who subscribes otherwise gets nothing that was
published before it came. A reliable subscriber hears nothing from a best-effort publisher. The depth of `bscan` and
`bscan_pose` is at least the number of B-scans, their reliability the trainer's parameter `bscan_reliability`.
`fit_progress` and `execution_status` keep their last 50 reports: Fast DDS hands a late joiner all of them, the newest
last.

A request that cannot be served never ends a node and never publishes a path: the caller gets an error code, `success:
false` or an empty path at once, the reason stands on the node's status topic and in its log. A DiagnosticArray carries
one status: its level, the message in words, and named values, `state` among them; lists and tables in it are JSON.

Parameters, with unit, range and default: [config/octn.yaml](../config/octn.yaml). Each node also has the parameter
services, `/parameter_events` and `/rosout` of any ROS 2 node.

Written by `python -m octn_ros.nodes.interface_page`, and held against the code by a test.
"""
_TITLES = {PUBLISHES: "Publishes", SUBSCRIBES: "Subscribes to", OFFERS: "Services"}


def interface_page(nodes: Sequence[Sequence[Interface]]) -> str:
    """Return the text of the page.

    Args:
        nodes: what each node offers and takes, in the order of the page.

    Raises:
        ConfigurationError: a topic or service has no meaning, or a meaning belongs to none of them.
    """
    used = {interface.name for interfaces in nodes for interface in interfaces}
    if used != set(MEANINGS):
        raise ConfigurationError(
            f"expected a meaning in interface_meanings.py for {sorted(used - set(MEANINGS)) or 'nothing more'}, and "
            f"none for {sorted(set(MEANINGS) - used) or 'anything else'}"
        )
    return "\n".join([_HEAD, *(line for interfaces in nodes for line in _section(interfaces))])


def _section(interfaces: Sequence[Interface]) -> Iterator[str]:
    yield f"## {interfaces[0].node}\n"
    for role, title in _TITLES.items():
        rows = [interface for interface in interfaces if interface.role == role]
        if not rows:
            continue
        columns = ["type", "meaning"] if role == OFFERS else ["type", "QoS", "meaning"]
        yield f"| {title} | {' | '.join(columns)} |"
        yield "| --- " * (len(columns) + 1) + "|"
        for row in rows:
            qos = [] if role == OFFERS else [row.qos_text]
            yield "| " + " | ".join([f"`{row.name}`", row.type, *qos, MEANINGS[row.name]]) + " |"
        yield ""


if __name__ == "__main__":
    print_text(lambda: interface_page(list(all_interfaces())))
