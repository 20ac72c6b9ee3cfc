"""Messages to arrays and back: the only place where the two meet.

Every function is pure and thread-safe. Lengths are metres, times nanoseconds, quaternions (x, y, z, w).
"""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseArray, PoseStamped, Quaternion
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header

from octn_ros.errors import CheckpointError, ExecutionError, VolumeError
from octn_ros.field import FORMAT
from octn_ros.planning import from_translation_quaternion, quaternions_xyzw
from octn_ros.volume import VolumeGeometry

LARGEST_GRID = 1 << 22  # cells of an en-face view: 4 MB on the wire
TOOL_PATH = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "qx", "qy", "qz", "qw")),
        ("segment", "<u4"),
        ("laser_on", "u1"),
        *((name, "<f4") for name in ("speed", "residual", "confidence")),
    ]
)

_ENCODINGS: dict[str, np.dtype[Any]] = {
    "mono8": np.dtype(np.uint8),
    "mono16": np.dtype(np.uint16),
    "32FC1": np.dtype(np.float32),
}
_POINT_FIELDS = {"<f4": PointField.FLOAT32, "<u4": PointField.UINT32, "|u1": PointField.UINT8}


def to_bytes_field(data: bytes | memoryview) -> array[int]:
    """Return what a uint8[] field takes without a Python loop over its items."""
    field = array("B")
    field.frombytes(data)
    return field


def shortest_decimal(value: float) -> float:
    """Return what the caller wrote into a float32 field: 5e-05, not 4.999999873689376e-05."""
    return float(str(np.float32(value)))


def stamp_to_ns(stamp: Time) -> int:
    """Return a message stamp in nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def header(stamp_ns: int, frame: str) -> Header:
    """Return a header with an acquisition time in nanoseconds and a frame."""
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame)


def pose_to_matrix(pose: Pose) -> NDArray[np.float64]:
    """Return a pose as the 4x4 transform that maps its own frame into that of its header.

    Raises:
        CalibrationError: a coordinate is not finite, or the quaternion is not of unit length within 1e-3.
    """
    place, turn = pose.position, pose.orientation
    return from_translation_quaternion((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def matrix_to_pose_stamped(a2b: NDArray[np.float64], stamp_ns: int, frame: str) -> PoseStamped:
    """Return the pose of frame A in frame B, whose name `frame` is."""
    return PoseStamped(header=header(stamp_ns, frame), pose=_poses(a2b[None])[0])


def to_pose_array(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> PoseArray:
    """Return transforms [N, 4, 4] as poses in `frame`; N may be 0."""
    return PoseArray(header=header(stamp_ns, frame), poses=_poses(poses))


def poses_to_matrices(poses: Sequence[Pose]) -> NDArray[np.float64]:
    """Return the poses of a PoseArray as transforms [N, 4, 4].

    Raises:
        ExecutionError: a coordinate is not finite, or a quaternion not of unit length within 1e-3.
    """
    rows = [
        (p.position.x, p.position.y, p.position.z, p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w)
        for p in poses
    ]
    numbers = np.array(rows, dtype=np.float64).reshape(-1, 7)
    # NaN fails this comparison too.
    good = np.isfinite(numbers).all(axis=1) & (np.abs(np.linalg.norm(numbers[:, 3:], axis=1) - 1.0) <= 1e-3)
    if not good.all():
        first = int(np.argmin(good))
        raise ExecutionError(
            f"expected finite poses with unit quaternions, got {np.count_nonzero(~good)} of {len(good)} others, "
            f"the first at {first}: {numbers[first].tolist()}"
        )
    matrices = np.tile(np.eye(4), (len(numbers), 1, 1))
    matrices[:, :3, 3] = numbers[:, :3]
    if len(numbers):
        matrices[:, :3, :3] = Rotation.from_quat(numbers[:, 3:]).as_matrix()
    return matrices


def to_path(poses: NDArray[np.float64], stamp_ns: int, frame: str) -> Path:
    """Return transforms [N, 4, 4] as a path in `frame`; N may be 0."""
    head = header(stamp_ns, frame)
    return Path(header=head, poses=[PoseStamped(header=head, pose=pose) for pose in _poses(poses)])


def _poses(poses: NDArray[np.float64]) -> list[Pose]:
    if not len(poses):
        return []
    places, turns = poses[:, :3, 3].tolist(), quaternions_xyzw(poses).tolist()
    return [
        Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(places, turns, strict=True)
    ]


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


def to_grid(enface: NDArray[np.float32], geometry: VolumeGeometry, stamp_ns: int) -> OccupancyGrid:
    """Return an en-face view [bscan, lateral] in [0, 1] as a grid of square cells with grey levels 0 to 100.

    Cells are as small as the finer of the two spacings, coarser where there would be more than `LARGEST_GRID` of
    them; each shows the nearest A-scan. Cell (0, 0) lies at the first A-scan, rows run along the bscan axis.
    """
    along, _, across = geometry.spacing_m
    x0, y0, z0 = geometry.origin_m
    bscans, laterals = enface.shape
    area = bscans * along * laterals * across
    cell = max(min(along, across), math.sqrt(area / LARGEST_GRID))
    columns = _nearest(laterals, across, cell)
    rows = _nearest(bscans, along, cell)
    grey = np.rint(np.clip(enface[np.ix_(rows, columns)], 0.0, 1.0) * 100.0).astype(np.int8)
    grid = OccupancyGrid(header=header(stamp_ns, geometry.frame))
    grid.info.map_load_time = grid.header.stamp
    grid.info.resolution = float(cell)
    grid.info.width, grid.info.height = len(columns), len(rows)
    # The grid's origin is the corner of its first cell, whose centre lies over the first A-scan.
    grid.info.origin.position = Point(x=x0 - cell / 2, y=y0 - cell / 2, z=z0)
    data = array("b")
    data.frombytes(grey.tobytes())
    grid.data = data
    return grid


def _nearest(samples: int, spacing: float, cell: float) -> NDArray[np.intp]:
    count = max(1, round((samples - 1) * spacing / cell) + 1)
    return np.minimum(np.rint(np.arange(count) * (cell / spacing)), samples - 1).astype(np.intp)


def to_field_message(data: bytes, stamp_ns: int, frame: str) -> CompressedImage:
    """Return a stored field as the message of the `field` topic; the stamp is the scan's."""
    return CompressedImage(header=header(stamp_ns, frame), format=FORMAT, data=to_bytes_field(data))


def field_data(message: CompressedImage) -> bytes:
    """Return the stored field that a message of the `field` topic carries.

    Raises:
        CheckpointError: the message is of another format.
    """
    if message.format != FORMAT:
        raise CheckpointError(f"expected a field of format {FORMAT!r}, got {message.format!r}")
    return bytes(message.data)


def tool_path(
    poses: NDArray[np.float64],
    segment: NDArray[Any],
    laser_on: NDArray[Any],
    speed_m_s: NDArray[Any],
    residual: NDArray[Any],
    confidence: NDArray[Any],
) -> NDArray[np.void]:
    """Return a plan as the structured array `TOOL_PATH` [N]: what a PoseArray cannot say."""
    rows = np.zeros(len(poses), TOOL_PATH)
    if len(poses):
        for name, column in zip(("x", "y", "z"), poses[:, :3, 3].T, strict=True):
            rows[name] = column
        for name, column in zip(("qx", "qy", "qz", "qw"), quaternions_xyzw(poses).T, strict=True):
            rows[name] = column
    rows["segment"], rows["laser_on"], rows["speed"] = segment, laser_on, speed_m_s
    rows["residual"], rows["confidence"] = residual, confidence
    return rows


def to_cloud(rows: NDArray[np.void], stamp_ns: int, frame: str) -> PointCloud2:
    """Return a structured array [N] of float32, uint32 and uint8 columns as an unordered point cloud.

    It is dense, as PointCloud2 means it, if every number is finite; a tool path with leads is not.
    """
    names = rows.dtype.names or ()
    columns = [rows.dtype.fields[name] for name in names]  # type: ignore[index]
    fields = [
        PointField(name=name, offset=int(column[1]), datatype=_POINT_FIELDS[column[0].str], count=1)
        for name, column in zip(names, columns, strict=True)
    ]
    return PointCloud2(
        header=header(stamp_ns, frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * len(rows),
        data=to_bytes_field(rows.tobytes()),
        is_dense=all(np.isfinite(rows[name]).all() for name in names),
    )


def cloud_to_tool_path(message: PointCloud2) -> NDArray[np.void]:
    """Return a `tool_path` message as the structured array `TOOL_PATH` [N].

    Raises:
        ExecutionError: the columns or the amount of data are not those of a tool path.
    """
    sent = {field.name: (field.offset, field.datatype) for field in message.fields}
    wanted = {
        name: (int(column[1]), _POINT_FIELDS[column[0].str])
        for name, column in TOOL_PATH.fields.items()  # type: ignore[union-attr]
    }
    count = message.width * message.height
    if sent != wanted or message.point_step != TOOL_PATH.itemsize or message.is_bigendian:
        raise ExecutionError(f"expected a tool path with the columns {sorted(wanted)}, got {sorted(sent)}")
    if len(message.data) != count * TOOL_PATH.itemsize:
        raise ExecutionError(f"expected {count} waypoints of {TOOL_PATH.itemsize} bytes, got {len(message.data)} bytes")
    return np.frombuffer(bytes(message.data), TOOL_PATH)
