"""The element headers of a MATLAB 5 file, checked before SciPy reads the elements.

SciPy takes the number of an element's type as an index without looking at it: a flipped bit there ends the process.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from octn_ros.errors import VolumeError

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_FLAGS = 6  # stored as unsigned 32-bit integers
_FLAG_COMPLEX = 0x08
_NUMBERS = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13)  # integers of 8 to 64 bits, single, double
_MAX_HEAD_BYTES = 2**12  # flags, dimensions and name of an array take less


def check_arrays(path: Path, names: list[str]) -> None:
    """Check that the named arrays of a MATLAB 5 file are real numbers of a type there is.

    Raises:
        VolumeError: the file is of another version, an element is damaged, or an array is complex.
    """
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
        order = {b"IM": "<", b"MI": ">"}.get(start[126:128])
        if order is None or len(start) < _HEADER_BYTES:
            raise VolumeError("expected a MATLAB file of version 5 to 7.3 (version 4 has no arrays of three axes)")
        while tag := file.read(8):
            if len(tag) < 8:
                raise VolumeError("the file is damaged or truncated: it ends within an element")
            kind, size = struct.unpack(f"{order}II", tag)
            following = file.tell() + size
            content = file.read(min(size, _MAX_HEAD_BYTES))
            if kind == _COMPRESSED:
                content = zlib.decompressobj().decompress(content, _MAX_HEAD_BYTES)
                kind, content = _whole_tag(content, order)[0], content[8:]
            if kind != _MATRIX:
                raise VolumeError(f"expected an array, got an element of type {kind}; the file is damaged")
            _check_array(content, order, names)
            file.seek(following)


def _check_array(content: bytes, order: str, names: list[str]) -> None:
    kind, flags, content = _element(content, order)
    if kind != _FLAGS or len(flags) < 8:
        raise VolumeError("the file is damaged: an array has no flags")
    _, _, content = _element(content, order)  # SciPy checks the dimensions itself
    _, name, content = _element(content, order)
    if name.rstrip(b"\0").decode("latin-1") not in names:
        return
    if struct.unpack_from(f"{order}I", flags)[0] >> 8 & _FLAG_COMPLEX:
        raise VolumeError("expected real intensities, got complex ones")
    kind, _ = _whole_tag(content, order)
    if (kind & 0xFFFF if kind >> 16 else kind) not in _NUMBERS:
        raise VolumeError(f"expected numbers, got an element of type {kind}; the file is damaged")


def _element(content: bytes, order: str) -> tuple[int, bytes, bytes]:
    """Return type and data of the first element, and what follows it."""
    kind, size = _whole_tag(content, order)
    if kind >> 16:  # up to four bytes of data stand in the tag itself
        return kind & 0xFFFF, content[4 : 4 + min(4, kind >> 16)], content[8:]
    return kind, content[8 : 8 + size], content[8 + size + -size % 8 :]


def _whole_tag(content: bytes, order: str) -> tuple[int, int]:
    if len(content) < 8:
        raise VolumeError("the file is damaged or truncated: it ends within an element, or its header is too long")
    kind, size = struct.unpack_from(f"{order}II", content)
    return kind, size
