"""Places the laser must not reach: boxes, and polygons extruded along the beam, in any calibrated frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from octn_ros.errors import PlanError
from octn_ros.planning.calibration import Calibration
from octn_ros.planning.region import polygon_region
from octn_ros.planning.transforms import invert

_FRAMES = ("oct", "ee", "base")


@dataclass(frozen=True, eq=False)
class KeepOut:
    """One forbidden place; read-only.

    Attributes:
        name: what people call it.
        frame: "oct", "ee" (the end effector at the time of the scan) or "base".
        shape: "box" or "polygon".
        corners_m: of a box, those with the smallest and the largest coordinates [2, 3] in `frame`; of a polygon, its
            corners [K, 3] in `frame`, in order: all above and below them along the OCT beam is forbidden.

    Raises:
        PlanError: the frame or the shape is unknown, or the corners do not span one.
    """

    name: str
    frame: str
    shape: str
    corners_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        corners = np.array(self.corners_m, dtype=np.float64)
        object.__setattr__(self, "corners_m", corners)
        corners.setflags(write=False)
        if self.frame not in _FRAMES or self.shape not in ("box", "polygon"):
            raise PlanError(
                f"keep-out region {self.name!r}: expected a box or a polygon in a frame of {', '.join(_FRAMES)}, "
                f"got a {self.shape} in {self.frame!r}"
            )
        if corners.ndim != 2 or corners.shape[1:] != (3,) or not np.isfinite(corners).all():
            raise PlanError(f"keep-out region {self.name!r}: expected finite corners (x, y, z), got {corners.tolist()}")
        if self.shape == "box" and (len(corners) != 2 or not (corners[1] > corners[0]).all()):
            raise PlanError(
                f"keep-out region {self.name!r}: expected min_m below max_m along x, y and z, got {corners.tolist()} m"
            )

    def distance_m(
        self, points_oct: NDArray[np.float64], oct2ee: NDArray[np.float64], ee2base: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Distance [N] of points (x, y, z) [N, 3] of the OCT frame to the region, 0 inside.

        Args:
            points_oct: in metres.
            oct2ee: calibration of the probe [4, 4].
            ee2base: pose of the end effector at the time of the scan [4, 4], None if unknown.

        Raises:
            PlanError: the region is given in the base frame and the pose is unknown, or a polygon is none seen along
                the beam.
        """
        oct2frame = self._oct2frame(oct2ee, ee2base)
        if self.shape == "box":
            points = points_oct @ oct2frame[:3, :3].T + oct2frame[:3, 3]
            beyond = np.maximum(np.maximum(self.corners_m[0] - points, points - self.corners_m[1]), 0.0)
            return np.asarray(np.linalg.norm(beyond, axis=1), dtype=np.float64)
        frame2oct = invert(oct2frame)
        corners = (self.corners_m @ frame2oct[:3, :3].T + frame2oct[:3, 3])[:, :2]
        try:
            corners = polygon_region(corners).vertices_m
        except PlanError as error:
            raise PlanError(f"keep-out region {self.name!r}: seen along the beam, {error}") from None
        return _polygon_distance(corners, points_oct[:, :2])

    def _oct2frame(self, oct2ee: NDArray[np.float64], ee2base: NDArray[np.float64] | None) -> NDArray[np.float64]:
        if self.frame == "oct":
            return np.eye(4)
        if self.frame == "ee":
            return oct2ee
        if ee2base is None:
            raise PlanError(
                f"keep-out region {self.name!r} is given in the robot's base frame, but the pose of the end effector "
                "at the time of the scan is not known; state the pose, or give the region in the frame oct or ee"
            )
        return np.asarray(ee2base @ oct2ee, dtype=np.float64)


def load_keep_out(path: str | Path, calibration: Calibration) -> tuple[KeepOut, ...]:
    """Read keep-out regions from a YAML file.

    Its form: `units: m` and a list `keep_out` of regions, each with `name`, `frame` (oct, ee, base, or the name that
    the calibration gives to one of them) and either `box: {min_m: [x, y, z], max_m: [x, y, z]}` or
    `polygon_m: [[x, y, z], ...]`, where the frame oct may leave z out.

    Raises:
        PlanError: the file is missing, no YAML or of another form, or a region is none.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise PlanError(f"expected a file of keep-out regions at {path}, could not read it: {error}") from error
    except yaml.YAMLError as error:
        raise PlanError(f"expected YAML in the keep-out regions {path}, could not parse it: {error}") from error
    try:
        return keep_out_from_plain(content, calibration)
    except PlanError as error:
        raise PlanError(f"{path}: {error}") from None


def keep_out_from_plain(content: Any, calibration: Calibration) -> tuple[KeepOut, ...]:
    """Make keep-out regions of the content of their file; see `load_keep_out`."""
    if not isinstance(content, dict) or set(content) != {"units", "keep_out"} or content["units"] != "m":
        raise PlanError(f"expected units: m and a list keep_out, got {_short(content)}")
    if not isinstance(content["keep_out"], list):
        raise PlanError(f"expected a list keep_out of regions, got {_short(content['keep_out'])}")
    names = dict(zip((calibration.oct_frame, calibration.ee_frame, calibration.base_frame), _FRAMES, strict=True))
    return tuple(_region(number, item, names) for number, item in enumerate(content["keep_out"]))


def _region(number: int, item: Any, names: dict[str, str]) -> KeepOut:
    if not isinstance(item, dict) or set(item) not in ({"name", "frame", "box"}, {"name", "frame", "polygon_m"}):
        raise PlanError(
            f"keep-out region {number}: expected name, frame and either box or polygon_m, got {_short(item)}"
        )
    name, frame = str(item["name"]), str(item["frame"])
    frame = names.get(frame, frame)
    if "box" in item:
        box = item["box"]
        if not isinstance(box, dict) or set(box) != {"min_m", "max_m"}:
            raise PlanError(f"keep-out region {name!r}: expected a box of min_m and max_m, got {_short(box)}")
        return KeepOut(name, frame, "box", _numbers(name, [box["min_m"], box["max_m"]]))
    corners = _numbers(name, item["polygon_m"])
    if corners.ndim == 2 and corners.shape[1] == 2 and frame == "oct":
        corners = np.column_stack([corners, np.zeros(len(corners))])
    return KeepOut(name, frame, "polygon", corners)


def _numbers(name: str, rows: Any) -> NDArray[np.float64]:
    # YAML 1.1 reads 1e-3 as a word; NumPy would take it for a number without a warning.
    flat = [item for row in rows if isinstance(row, list) for item in row] if isinstance(rows, list) else []
    numbers = [item for item in flat if isinstance(item, (int, float)) and not isinstance(item, bool)]
    try:
        if not flat or len(numbers) != len(flat):
            raise ValueError
        return np.array(rows, dtype=np.float64)
    except ValueError:
        raise PlanError(
            f"keep-out region {name!r}: expected corners of numbers, got {_short(rows)}; write 1.0e-3, not 1e-3"
        ) from None


def _polygon_distance(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance [N] of points [N, 2] to a polygon [K, 2], 0 inside."""
    nearest, inside = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.bool_)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = end - start
        share = np.clip((points - start) @ edge / (edge @ edge), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - start - share[:, None] * edge, axis=1))
        if start[1] != end[1]:
            crossed = (start[1] <= points[:, 1]) != (end[1] <= points[:, 1])
            at = start[0] + (points[:, 1] - start[1]) / edge[1] * edge[0]
            inside ^= crossed & (points[:, 0] < at)
    return np.where(inside, 0.0, nearest)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 120 else text[:117] + "..."
