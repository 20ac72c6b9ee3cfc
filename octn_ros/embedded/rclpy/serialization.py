"""Messages to bytes and back."""

from __future__ import annotations

from typing import Any

from octn_ros.embedded import message as _message


def serialize_message(message: Any) -> bytes:
    """Return the CDR encoding of a message."""
    return _message.serialize(message)


def deserialize_message(serialized_message: bytes, message_type: Any) -> Any:
    """Return the message of class `message_type` that the bytes encode."""
    return _message.deserialize(serialized_message, message_type)
