"""Times and frames of messages."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from octn_ros.errors import OctnError

LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # of plain CDR; places in the encoding are counted from behind it


def stamp_to_ns(stamp: Time) -> int:
    """Return a message stamp in nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def header(stamp_ns: int, frame: str) -> Header:
    """Return a header with an acquisition time in nanoseconds and a frame.

    Raises:
        OctnError: the time lies outside the 32 bits that a message has for its seconds.
    """
    seconds, nanoseconds = _split(stamp_ns)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame)


def encode_header(stamp_ns: int, frame: str) -> bytes:
    """Return the encoding of a Header, which begins at a multiple of 4.

    Raises:
        OctnError: as `header`.
    """
    seconds, nanoseconds = _split(stamp_ns)
    name = frame.encode() + b"\0"
    return (
        seconds.to_bytes(4, "little", signed=True)
        + nanoseconds.to_bytes(4, "little")
        + len(name).to_bytes(4, "little")
        + name
    )


def _split(stamp_ns: int) -> tuple[int, int]:
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    if not -(1 << 31) <= seconds < 1 << 31:  # which a message with a billion nanoseconds and more can add up to
        raise OctnError(f"expected a stamp of {-(1 << 31)} to {(1 << 31) - 1} s, got {stamp_ns} ns")
    return seconds, nanoseconds
