"""The fitted field as a message."""

from __future__ import annotations

from collections.abc import Sequence

from sensor_msgs.msg import CompressedImage

from octn_ros.errors import CheckpointError
from octn_ros.field import FORMAT
from octn_ros.nodes.conversions.buffers import to_bytes_field
from octn_ros.nodes.conversions.headers import LITTLE_ENDIAN, encode_header, header


def to_field_message(data: bytes, stamp_ns: int, frame: str) -> CompressedImage:
    """Return a stored field as the message of the `field` topic; the stamp is the scan's."""
    return CompressedImage(header=header(stamp_ns, frame), format=FORMAT, data=to_bytes_field(data))


def encode_field(parts: Sequence[bytes | memoryview], stamp_ns: int, frame: str) -> bytes:
    """Return the bytes of the message that `to_field_message` makes of a stored field in parts, in a single copy.

    The field through the voxels of a large C-scan is as large as the C-scan. Plain CDR, little-endian, as every RMW
    of ROS 2 takes it from a publisher.
    """
    head = bytearray(LITTLE_ENDIAN + encode_header(stamp_ns, frame))  # four bytes before it: multiples of 4 stay such
    for length, text in ((len(FORMAT) + 1, FORMAT.encode() + b"\0"), (sum(map(len, parts)), b"")):
        head += bytes(-len(head) % 4) + length.to_bytes(4, "little") + text
    return b"".join((head, *parts))


def field_data(message: CompressedImage) -> bytes:
    """Return the stored field that a message of the `field` topic carries.

    Raises:
        CheckpointError: the message is of another format.
    """
    if message.format != FORMAT:
        raise CheckpointError(f"expected a field of format {FORMAT!r}, got {message.format!r}")
    return bytes(message.data)
