"""Times and frames of messages."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # of plain CDR; places in the encoding are counted from behind it


def stamp_to_ns(stamp: Time) -> int:
    """Return a message stamp in nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def header(stamp_ns: int, frame: str) -> Header:
    """Return a header with an acquisition time in nanoseconds and a frame."""
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame)


def encode_header(stamp_ns: int, frame: str) -> bytes:
    """Return the encoding of a Header, which begins at a multiple of 4."""
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    name = frame.encode() + b"\0"
    return (
        seconds.to_bytes(4, "little", signed=True)
        + nanoseconds.to_bytes(4, "little")
        + len(name).to_bytes(4, "little")
        + name
    )
