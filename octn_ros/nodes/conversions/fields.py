"""The fitted field as a message."""

from __future__ import annotations

from sensor_msgs.msg import CompressedImage

from octn_ros.errors import CheckpointError
from octn_ros.field import FORMAT
from octn_ros.nodes.conversions.buffers import to_bytes_field
from octn_ros.nodes.conversions.headers import header


def to_field_message(data: bytes, stamp_ns: int, frame: str) -> CompressedImage:
    """Return a stored field as the message of the `field` topic; the stamp is the scan's."""
    return CompressedImage(header=header(stamp_ns, frame), format=FORMAT, data=to_bytes_field(data))


def field_data(message: CompressedImage) -> bytes:
    """Return the stored field that a message of the `field` topic carries.

    Raises:
        CheckpointError: the message is of another format.
    """
    if message.format != FORMAT:
        raise CheckpointError(f"expected a field of format {FORMAT!r}, got {message.format!r}")
    return bytes(message.data)
