"""The fitted field as a node receives it: checked, loaded, and handed out as one immutable record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage

from octn_ros.errors import OctnError
from octn_ros.field import Field, field_hash, loads_field
from octn_ros.nodes import conversions, qos


@dataclass(frozen=True)
class ReceivedField:
    """A field and its identity on the wire.

    Attributes:
        field: the field, on the node's device.
        hash: identity of its bytes, 16 hex digits.
        stamp_ns: acquisition time of the scan it was fitted to.
        frame: the OCT frame's name.
    """

    field: Field
    hash: str
    stamp_ns: int
    frame: str


class FieldReceiver:
    """Subscribes to `field` and keeps the last good one; a bad message is reported and changes nothing.

    Args:
        node: the node that listens.
        device: where the field is put.
        received: called with each new field.
        refused: called with the reason why a message was not accepted.
        group: callback group of the subscription; one that `plan` services share never mixes two fields.
    """

    def __init__(
        self,
        node: Node,
        device: torch.device,
        received: Callable[[ReceivedField], None],
        refused: Callable[[str], None],
        group: CallbackGroup,
    ) -> None:
        self._device, self._received, self._refused = device, received, refused
        self._current: ReceivedField | None = None
        node.create_subscription(CompressedImage, "field", self._on_field, qos.LATCHED, callback_group=group)

    @property
    def current(self) -> ReceivedField | None:
        """The present field, None before the first."""
        return self._current

    def _on_field(self, message: CompressedImage) -> None:
        try:
            data = conversions.field_data(message)
            field = loads_field(data, self._device)
            stamp_ns = conversions.stamp_to_ns(message.header.stamp)
            received = ReceivedField(field, field_hash(data), stamp_ns, message.header.frame_id)
            self._received(received)
        except OctnError as error:
            self._refused(str(error))
        except Exception as error:  # a fault of ours, or the device's memory is full: the node lives on
            self._refused(f"{type(error).__name__}: {error}")
        else:
            self._current = received
