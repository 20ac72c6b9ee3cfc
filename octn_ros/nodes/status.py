"""What a node says about itself: one diagnostic status per topic, in words and in named values."""

from __future__ import annotations

import json
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSProfile

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class StatusTopic:
    """Publishes the state of one thing as a DiagnosticArray and writes it to the log; safe from any thread.

    Args:
        node: the node that speaks.
        topic: the topic's relative name, also the name of the status.
        profile: latched where only the last state counts.
    """

    def __init__(self, node: Node, topic: str, profile: QoSProfile) -> None:
        self._node = node
        self._name = f"{node.get_name()}: {topic}"
        self._publisher = node.create_publisher(DiagnosticArray, topic, profile)

    def report(self, level: bytes, message: str, values: dict[str, Any] | None = None, *, log: bool = True) -> None:
        """Publish a state; `values` may hold anything that JSON can.

        Args:
            level: OK, WARN or ERROR.
            message: the state or the reason in words.
            values: named figures, numbers as plain text, lists and dicts as JSON.
            log: whether the message also goes to the log.
        """
        if not self._node.context.ok():
            return  # the graph is gone, and the log with it
        report = to_report(self._node, self._name, level, message, values or {})
        if log:
            logger = self._node.get_logger()
            # One call site per severity: rclpy refuses a call site that changes its severity.
            if level == OK:
                logger.info(message)
            elif level == WARN:
                logger.warning(message)
            else:
                logger.error(message)
        self._publisher.publish(report)


def to_report(node: Node, name: str, level: bytes, message: str, values: dict[str, Any]) -> DiagnosticArray:
    """Return a message with one status of this name, stamped with the node's time now.

    Raises:
        TypeError: there is something in `values` that JSON cannot hold.
    """
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    status = DiagnosticStatus(level=level, name=name, message=message, hardware_id="octn_ros", values=pairs)
    report = DiagnosticArray(status=[status])
    report.header.stamp = node.get_clock().now().to_msg()
    return report


def read(message: DiagnosticArray) -> tuple[bytes, str, dict[str, str]]:
    """Return level, message and values of a report's first status."""
    status = message.status[0]
    return status.level, status.message, {pair.key: pair.value for pair in status.values}


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.9g}"
    return json.dumps(value)
