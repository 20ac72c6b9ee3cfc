"""The fitted field as a message."""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage

from octn_ros.errors import CheckpointError
from octn_ros.field import FORMAT, field_hash, volume_parts
from octn_ros.nodes.conversions.buffers import to_bytes_field
from octn_ros.nodes.conversions.headers import LITTLE_ENDIAN, encode_header, header
from octn_ros.volume import Volume

_HEAD_BYTES = 4096  # what a stored field says before its voxels has a quarter of this


def to_field_message(data: bytes, stamp_ns: int, frame: str) -> CompressedImage:
    """Return a stored field as the message of the `field` topic; the stamp is the scan's."""
    return CompressedImage(header=header(stamp_ns, frame), format=FORMAT, data=to_bytes_field(data))


def voxel_room(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return room for the voxels of a C-scan within what will be the data of their field's message, filled with zeros.

    The field through the voxels of a large C-scan is as large as the C-scan. From here `with_field_message` makes its
    message without a copy.
    """
    return _voxels_in(_data(math.prod(shape) * dtype.itemsize), shape, dtype)


def with_field_message(volume: Volume) -> tuple[Volume, CompressedImage, str]:
    """Return a C-scan, the message of the field through its voxels, and that field's hash.

    Voxels and message share their memory, so neither may be written to. Voxels that lie in a `voxel_room` stay there;
    others are copied into one, and the volume that is returned has those.

    Raises:
        CheckpointError: the frame's name is so long that there is no room for it.
    """
    head, voxels = volume_parts(volume, _HEAD_BYTES)
    if len(head) != _HEAD_BYTES:
        raise CheckpointError(f"expected a field's header of at most {_HEAD_BYTES} bytes, got {len(head)}")
    data = _data_around(voxels)
    if data is None:
        data = _data(len(voxels))
        memoryview(data)[_HEAD_BYTES:] = voxels
        shape, dtype = volume.array.shape, volume.array.dtype.newbyteorder("<")
        volume = dataclasses.replace(volume, array=_voxels_in(data, shape, dtype))
    memoryview(data)[:_HEAD_BYTES] = head
    message = CompressedImage(header=header(volume.stamp_ns, volume.geometry.frame), format=FORMAT, check_fields=True)
    message.data = data  # a message that checks its fields keeps it; others, and all constructors, make a copy
    return volume, message, field_hash(head, voxels)


def _data(voxel_bytes: int) -> array[int]:
    return array("B", bytes(1)) * (_HEAD_BYTES + voxel_bytes)


def _voxels_in(data: array[int], shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    return np.frombuffer(data, dtype, offset=_HEAD_BYTES).reshape(shape)


def _data_around(voxels: memoryview) -> array[int] | None:
    """Return the data of the message in whose memory voxels lie as `voxel_room` places them; None for others."""
    owner: Any = voxels
    while isinstance(owner, (np.ndarray, memoryview)):
        owner = owner.base if isinstance(owner, np.ndarray) else owner.obj
    if not isinstance(owner, array) or len(owner) * owner.itemsize != _HEAD_BYTES + len(voxels):
        return None
    here, there = np.frombuffer(voxels, np.uint8), np.frombuffer(owner, np.uint8, offset=_HEAD_BYTES)
    return owner if here.ctypes.data == there.ctypes.data else None


def encode_field(parts: Sequence[bytes | memoryview], stamp_ns: int, frame: str) -> bytes:
    """Return the bytes of the message that `to_field_message` makes of a stored field in parts, in a single copy.

    Plain CDR, little-endian, as every RMW of ROS 2 takes it from a publisher.
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
