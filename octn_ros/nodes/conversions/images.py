"""B-scans, slices and coloured pictures to image messages, and B-scans back."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from octn_ros.errors import VolumeError
from octn_ros.nodes.conversions.buffers import to_bytes_field
from octn_ros.nodes.conversions.headers import header

_ENCODINGS: dict[str, np.dtype[Any]] = {
    "mono8": np.dtype(np.uint8),
    "mono16": np.dtype(np.uint16),
    "32FC1": np.dtype(np.float32),
}


def to_image(pixels: NDArray[Any], stamp_ns: int, frame: str) -> Image:
    """Return a B-scan [axial, lateral] of type uint8, uint16 or float32 as an image.

    Raises:
        VolumeError: another type or another number of axes.
    """
    encoding = next((name for name, dtype in _ENCODINGS.items() if dtype == pixels.dtype), None)
    if encoding is None or pixels.ndim != 2:
        raise VolumeError(
            f"expected a B-scan [axial, lateral] of uint8, uint16 or float32, got {pixels.dtype} {pixels.shape}"
        )
    data = np.ascontiguousarray(pixels)
    return Image(
        header=header(stamp_ns, frame),
        height=data.shape[0],
        width=data.shape[1],
        encoding=encoding,
        is_bigendian=int(sys.byteorder == "big"),
        step=data.strides[0],
        data=to_bytes_field(data.tobytes()),
    )


def to_colour_image(pixels: NDArray[np.uint8], stamp_ns: int, frame: str) -> Image:
    """Return a picture [rows, columns, (red, green, blue)] as an image."""
    height, width, _ = pixels.shape
    return Image(
        header=header(stamp_ns, frame),
        height=height,
        width=width,
        encoding="rgb8",
        is_bigendian=0,
        step=3 * width,
        data=to_bytes_field(np.ascontiguousarray(pixels).tobytes()),
    )


def image_to_array(message: Image) -> NDArray[Any]:
    """Return an image as an array [axial, lateral] of the machine's byte order, row padding removed.

    Raises:
        VolumeError: another encoding than mono8, mono16 or 32FC1, or sizes that disagree with the data.
    """
    dtype = _ENCODINGS.get(message.encoding)
    if dtype is None:
        raise VolumeError(f"expected an image encoded as {', '.join(_ENCODINGS)}, got {message.encoding!r}")
    height, width, step = message.height, message.width, message.step
    if height < 1 or width < 1 or step < width * dtype.itemsize or len(message.data) != height * step:
        raise VolumeError(
            f"expected {height} x {width} pixels of {dtype.itemsize} bytes in rows of at least "
            f"{width * dtype.itemsize} bytes, got step {step} and {len(message.data)} bytes in all"
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : width * dtype.itemsize]
    sent = dtype.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(rows).view(sent).astype(dtype)
