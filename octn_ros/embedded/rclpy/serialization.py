"""Messages to their encoding (CDR, little-endian) and back."""

from __future__ import annotations

from typing import Any

from octn_ros.embedded import message as codec


def serialize_message(message: Any) -> bytes:
    """Return the encoding of a message, which a publisher takes in place of it."""
    return codec.serialize(message)


def deserialize_message(serialized_message: bytes, message_type: Any) -> Any:
    """Return the message of a type that was encoded.

    Raises:
        ValueError: the data is not little-endian CDR.
        struct.error, IndexError, UnicodeDecodeError: it is not of this type.
    """
    return codec.deserialize(serialized_message, message_type)
