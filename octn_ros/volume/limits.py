"""How much memory a file may claim: against its own size, against compression bombs, against a limit in bytes."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from octn_ros.errors import VolumeError
from octn_ros.volume.volume import kept_type

DEFAULT_MAX_BYTES = 4 * 2**30
# Measured OCT data shrinks to a half at best, a phantom of flat layers to a twentieth. What claims to have been
# more than a hundred times its size is a bomb, unless it is small anyway.
_MAX_EXPANSION = 100
_HARMLESS_BYTES = 256 * 2**20
_DEFLATE_MAX_EXPANSION = 1032  # no deflate stream expands more


@dataclass(frozen=True)
class ReadLimit:
    """What a reader may allocate; immutable.

    Attributes:
        max_bytes: the most bytes that the voxels may take in memory. None: 4 GiB, and for compressed data no more
            than a hundred times the size of the file (256 MiB are always allowed).
        max_voxels: the most voxels; None for any number.
    """

    max_bytes: int | None = None
    max_voxels: int | None = None

    def check(self, claimed: int, stored: int, *, compressed: bool, kept: int = 0) -> None:
        """Refuse a claim before anything is allocated for it.

        Args:
            claimed: bytes of the voxels as the file's header has them.
            stored: bytes that the file really has for them.
            compressed: whether the stored bytes have to be expanded.
            kept: bytes of the voxels in memory after conversion, where that is more.

        Raises:
            VolumeError: the file is shorter than it claims, or the claim is above the limit.
        """
        if not compressed and claimed > stored:
            raise VolumeError(
                f"the file is damaged or truncated: its header claims {claimed:,} bytes of voxels, it has {stored:,}"
            )
        limit = DEFAULT_MAX_BYTES if self.max_bytes is None else self.max_bytes
        if self.max_bytes is None and compressed:
            limit = min(limit, max(_HARMLESS_BYTES, _MAX_EXPANSION * stored))
        needed = max(claimed, kept)
        if needed > limit:
            raise VolumeError(
                f"expected at most {limit:,} bytes of voxels, the header claims {needed:,}; if the file is sound, "
                "raise the limit with --max-bytes, in Python with max_bytes"
            )

    def check_array(self, shape: tuple[int, ...], dtype: np.dtype[Any], stored: int, *, compressed: bool) -> None:
        """Refuse an array that is no C-scan, or that claims more than it has or may.

        Args:
            shape: as the file's header has it.
            dtype: type of one voxel in the file.
            stored: bytes that the file really has for the voxels.
            compressed: whether the stored bytes have to be expanded.

        Raises:
            VolumeError: see above.
        """
        if len(shape) != 3:
            raise VolumeError(f"expected three axes [bscan, axial, lateral], got {shape}")
        if min(shape) < 1:
            raise VolumeError(f"expected voxels, the file claims a shape of {shape}")
        if dtype.kind not in "uif":
            raise VolumeError(f"expected real intensities, got type {dtype}")
        voxels = math.prod(shape)
        if self.max_voxels is not None and voxels > self.max_voxels:
            raise VolumeError(
                f"expected at most {self.max_voxels:,} voxels, the header claims {' x '.join(map(str, shape))} = "
                f"{voxels:,}; cut the scan, or raise the limit if there is memory for it"
            )
        kept = voxels * kept_type(dtype).itemsize
        self.check(voxels * dtype.itemsize, stored, compressed=compressed, kept=kept)


def check_deflated(data: bytes, expected: int) -> None:
    """Refuse a zlib stream that expands to more than it should, without keeping what comes out.

    Libraries inflate a whole segment at once whatever it holds. Short segments cannot do harm and are not tried.

    Raises:
        VolumeError: more than `expected` bytes come out.
    """
    if len(data) * _DEFLATE_MAX_EXPANSION <= _HARMLESS_BYTES:
        return
    stream, total = zlib.decompressobj(), 0
    while data and not stream.eof:
        total += len(stream.decompress(data, 2**20))
        data = stream.unconsumed_tail
        if total > expected:
            raise VolumeError(f"expected {expected:,} bytes in a compressed segment, got more; the file is damaged")
