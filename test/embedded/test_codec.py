"""The codec against rosbags' own, on every message type."""

import random
import time
from array import array

import numpy as np
import pytest
from std_msgs.msg import UInt8MultiArray

typesys = pytest.importorskip("rosbags.typesys", reason="rosbags belongs to the extra `embedded`")
pytest.importorskip("zenoh", reason="eclipse-zenoh belongs to the extra `embedded`")

from octn_ros.embedded import definitions, message  # noqa: E402 - needs both

REFERENCE = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
TYPES = sorted(REFERENCE.fielddefs)
MESSAGES_PER_TYPE = 10
BIG = 67_000_000
BIG_SEC = 2.0  # a Python loop over as many bytes takes longer


def scalar(base, rng):
    if base == "string":
        return "".join(rng.choice("abcäöx€") for _ in range(rng.randrange(6)))
    if base == "bool":
        return rng.random() < 0.5
    if base == "byte":
        return bytes([rng.randrange(128)])  # rosbags packs a byte with its sign
    if base.startswith("float"):
        return float(np.dtype(base).type(rng.uniform(-9, 9)))
    limits = np.iinfo(base)
    return rng.randrange(int(limits.min), int(limits.max) + 1)


def both(kind, argument, rng):
    """A random value as our messages hold it and as those of rosbags do."""
    if kind == definitions.NAME:
        return both_messages(argument, rng)
    if kind == definitions.BASE:
        value = scalar(argument[0], rng)
        if argument[1]:
            value = value[: argument[1]]
        return value, value[0] if argument[0] == "byte" else value
    (item_kind, item), size = argument
    count = size if kind == definitions.ARRAY else rng.randrange(min(size or 4, 4) + 1)
    pairs = [both(item_kind, item, rng) for _ in range(count)]
    ours, theirs = [p[0] for p in pairs], [p[1] for p in pairs]
    if item_kind == definitions.BASE and item[0] != "string":
        theirs = np.array(theirs, dtype={"byte": "uint8"}.get(item[0], item[0]))
    return ours, theirs


def both_messages(name, rng):
    ours, theirs = {}, []
    for field, (kind, argument) in definitions.fields(name):
        if field == definitions.FILLER:
            theirs.append(0)
            continue
        value, their_value = both(kind, argument, rng)
        ours[field] = value
        theirs.append(their_value)
    return message.message_class(name)(**ours), REFERENCE.types[name](*theirs)


@pytest.mark.parametrize("name", TYPES)
def test_bytes_equal_those_of_rosbags_and_come_back_as_the_same_message(name):
    rng = random.Random(name)
    for _ in range(MESSAGES_PER_TYPE):
        ours, theirs = both_messages(name, rng)
        data = message.serialize(ours)
        assert data == bytes(REFERENCE.serialize_cdr(theirs, name))
        back = message.deserialize(data, type(ours))
        assert back == ours
        assert message.serialize(back) == data


def test_big_endian_and_truncated_data_are_refused():
    data = message.serialize(UInt8MultiArray(data=b"abc"))
    with pytest.raises(ValueError, match="little-endian"):
        message.deserialize(b"\x00\x00" + data[2:], UInt8MultiArray)
    with pytest.raises(ValueError, match="little-endian"):
        message.deserialize(b"", UInt8MultiArray)


def test_a_byte_above_127_passes():
    from diagnostic_msgs.msg import DiagnosticStatus

    status = DiagnosticStatus(level=b"\xff")
    assert message.deserialize(message.serialize(status), DiagnosticStatus).level == b"\xff"


def test_67_megabytes_pass_without_a_loop_over_bytes():
    values = array("B")
    values.frombytes(bytes(BIG))
    start = time.process_time()
    for given in (values, np.zeros(BIG, np.uint8), bytes(BIG)):
        data = message.serialize(UInt8MultiArray(data=given))
    back = message.deserialize(data, UInt8MultiArray)
    assert time.process_time() - start < BIG_SEC
    assert len(back.data) == BIG
