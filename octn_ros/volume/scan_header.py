"""What travels with the voxels in every file this package writes, and what a reader hands over."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.geometry import OCT_FRAME
from octn_ros.volume.limits import ReadLimit
from octn_ros.volume.volume import INTENSITY_SCALES, IntensityScale, Volume

_JSON_KEY = "octn_volume"


@dataclass(frozen=True)
class ScanHeader:
    """Everything about a C-scan but its voxels; what a file does not state has its default. Immutable.

    Attributes:
        spacing_m: metres between voxels along (bscan, axial, lateral), None if unstated.
        origin_m: centre of voxel (0, 0, 0) as (lateral, bscan, axial) in metres.
        frame: name of the frame the origin is in.
        intensity_range: raw values that become 0 and 1, None if unstated.
        intensity_scale: linear, log or unknown.
        stamp_ns: acquisition time in nanoseconds, 0 if unknown.
    """

    spacing_m: tuple[float, float, float] | None = None
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame: str = OCT_FRAME
    intensity_range: tuple[float, float] | None = None
    intensity_scale: IntensityScale = "unknown"
    stamp_ns: int = 0

    @classmethod
    def of(cls, volume: Volume) -> ScanHeader:
        """Return the header of a volume."""
        geometry = volume.geometry
        return cls(
            spacing_m=geometry.spacing_m,
            origin_m=geometry.origin_m,
            frame=geometry.frame,
            intensity_range=volume.intensity_range,
            intensity_scale=volume.intensity_scale,
            stamp_ns=volume.stamp_ns,
        )

    @classmethod
    def from_plain(cls, values: dict[str, Any]) -> ScanHeader:
        """Rebuild a header from values that came out of a file; unknown keys are ignored, missing ones default.

        Raises:
            VolumeError: a value is of no use.
        """
        scale, frame, stamp = (values.get(key) for key in ("intensity_scale", "frame", "stamp_ns"))
        if scale is not None and scale not in INTENSITY_SCALES:
            raise VolumeError(f"expected an intensity_scale of {', '.join(INTENSITY_SCALES)}, got {scale!r:.40}")
        if frame is not None and not (isinstance(frame, str) and 0 < len(frame) <= 200):
            raise VolumeError(f"expected the name of a frame, got {frame!r:.40}")
        if stamp is not None and (not isinstance(stamp, int) or isinstance(stamp, bool) or not 0 <= stamp < 2**63):
            raise VolumeError(f"expected stamp_ns in nanoseconds, got {stamp!r:.40}")
        return cls(
            spacing_m=_numbers(values, "spacing_m", 3),  # type: ignore[arg-type]
            origin_m=_numbers(values, "origin_m", 3) or (0.0, 0.0, 0.0),  # type: ignore[arg-type]
            frame=frame or OCT_FRAME,
            intensity_range=_numbers(values, "intensity_range", 2),  # type: ignore[arg-type]
            intensity_scale=scale or "unknown",
            stamp_ns=stamp or 0,
        )

    def to_plain(self) -> dict[str, Any]:
        """Return the header as lists, numbers and strings; what is unstated is left out."""
        values: dict[str, Any] = {
            "spacing_m": self.spacing_m,
            "origin_m": self.origin_m,
            "frame": self.frame,
            "intensity_range": self.intensity_range,
            "intensity_scale": self.intensity_scale,
            "stamp_ns": self.stamp_ns,
        }
        plain = {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
        return {key: value for key, value in plain.items() if value is not None}

    def to_json(self) -> str:
        """Return the header as one ASCII line of JSON, for the comment field of a file."""
        return json.dumps({_JSON_KEY: self.to_plain()})

    @classmethod
    def from_json(cls, text: str | bytes) -> ScanHeader | None:
        """Read a comment field; None if it is somebody else's.

        Raises:
            VolumeError: it is ours, but a value in it is of no use.
        """
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            return None
        values = content.get(_JSON_KEY) if isinstance(content, dict) else None
        return cls.from_plain(values) if isinstance(values, dict) else None


@dataclass(frozen=True)
class ReadRequest:
    """What a reader needs to know beside the path; immutable.

    Attributes:
        limit: how much it may allocate.
        variable: which array, where a file may hold several; None if there must be one only.
    """

    limit: ReadLimit = dataclasses.field(default_factory=ReadLimit)
    variable: str | None = None


@dataclass(frozen=True)
class RawScan:
    """A C-scan as its file has it: the header now, the voxels when asked for.

    So a missing spacing is told before gigabytes are read.

    Attributes:
        header: what the file states; the spacing is along the axes in the file's own order.
        shape: of the array, in the file's own order.
        dtype: type of its voxels, as `read_voxels` gives them; None where only the voxels tell it.
        read_voxels: reads the array, three axes in the file's own order.
        type_range: range of the integers in the file, where the array has another type; None: as the array has it.
    """

    header: ScanHeader
    shape: tuple[int, ...]
    dtype: np.dtype[Any] | None
    read_voxels: Callable[[], NDArray[Any]]
    type_range: tuple[float, float] | None = None


def _numbers(values: dict[str, Any], key: str, count: int) -> tuple[float, ...] | None:
    given = values.get(key)
    if given is None:
        return None
    numbers = list(given) if isinstance(given, (list, tuple)) else [given]
    if len(numbers) != count or not all(
        isinstance(n, (int, float)) and not isinstance(n, bool) and abs(n) < 1e300 and math.isfinite(n) for n in numbers
    ):
        raise VolumeError(f"expected {count} finite numbers as {key}, got {given!r:.80}")
    return tuple(float(n) for n in numbers)
