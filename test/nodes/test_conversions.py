import array
import sys

import numpy as np
import pytest
from geometry_msgs.msg import Pose, PoseStamped
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import CompressedImage, Image, PointField
from std_msgs.msg import Header

from octn_ros import field
from octn_ros.errors import CalibrationError, CheckpointError, ExecutionError, VolumeError
from octn_ros.nodes import conversions
from octn_ros.planning import from_translation_quaternion
from octn_ros.volume import VolumeGeometry

LARGEST_STAMP_NS = (2**31 - 1) * 10**9 + 999_999_999


@given(st.integers(0, LARGEST_STAMP_NS))
def test_a_stamp_survives_the_message(stamp_ns: int) -> None:
    head = conversions.header(stamp_ns, "tool0")
    assert isinstance(head, Header)
    assert head.frame_id == "tool0"
    assert conversions.stamp_to_ns(head.stamp) == stamp_ns


@pytest.mark.parametrize("written", [5e-5, 1e-4, 0.0, 1e-9, 0.123456])
def test_a_float32_gives_back_what_was_written(written: float) -> None:
    assert conversions.shortest_decimal(float(np.float32(written))) == written


@pytest.mark.parametrize(("dtype", "encoding"), [(np.uint8, "mono8"), (np.uint16, "mono16"), (np.float32, "32FC1")])
def test_an_image_keeps_every_pixel(dtype: type, encoding: str) -> None:
    pixels = (np.arange(15).reshape(3, 5) * 17).astype(dtype)
    message = conversions.to_image(pixels, 7, "oct_bscan_frame")
    assert (message.height, message.width, message.encoding) == (3, 5, encoding)
    assert isinstance(message.data, array.array)
    back = conversions.image_to_array(message)
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, pixels)


def test_an_image_of_the_other_byte_order_with_padded_rows_is_understood() -> None:
    pixels = np.array([[1, 256, 515], [4, 5, 65535]], np.uint16)
    other = ">" if sys.byteorder == "little" else "<"
    rows = np.zeros((2, 8), np.uint8)
    rows[:, :6] = pixels.astype(f"{other}u2").view(np.uint8)
    message = Image(height=2, width=3, encoding="mono16", is_bigendian=int(other == ">"), step=8)
    message.data = conversions.to_bytes_field(rows.tobytes())
    np.testing.assert_array_equal(conversions.image_to_array(message), pixels)


@pytest.mark.parametrize(
    "change",
    [{"encoding": "rgb8"}, {"width": 4}, {"height": 3}, {"step": 2}, {"height": 0}, {"data": array.array("B", [1])}],
)
def test_an_image_that_contradicts_itself_is_refused(change: dict) -> None:
    message = conversions.to_image(np.ones((2, 3), np.uint8), 0, "")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(VolumeError, match="expected"):
        conversions.image_to_array(message)


def test_colour_and_double_images_are_not_made() -> None:
    for pixels in (np.zeros((2, 3, 3), np.uint8), np.zeros((2, 3))):
        with pytest.raises(VolumeError, match="expected a B-scan"):
            conversions.to_image(pixels, 0, "")


def poses(count: int) -> np.ndarray:
    generator = np.random.default_rng(1)
    turns = generator.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return np.stack([from_translation_quaternion(generator.normal(size=3), turn) for turn in turns])


def test_poses_survive_the_messages() -> None:
    matrices = poses(20)
    message = conversions.to_pose_array(matrices, 3, "tool0")
    np.testing.assert_allclose(conversions.poses_to_matrices(message.poses), matrices, atol=1e-12)
    path = conversions.to_path(matrices, 3, "tool0")
    assert [stamped.pose for stamped in path.poses] == list(message.poses)
    assert all(stamped.header == path.header for stamped in path.poses)
    one = conversions.matrix_to_pose_stamped(matrices[0], 3, "tool0")
    assert isinstance(one, PoseStamped)
    np.testing.assert_allclose(conversions.pose_to_matrix(one.pose), matrices[0], atol=1e-12)


def test_no_poses_are_no_poses() -> None:
    empty = np.empty((0, 4, 4))
    assert not conversions.to_pose_array(empty, 0, "").poses
    assert not conversions.to_path(empty, 0, "").poses
    assert conversions.poses_to_matrices([]).shape == (0, 4, 4)


@pytest.mark.parametrize("bad", [float("nan"), 0.5])
def test_a_pose_that_is_none_is_refused(bad: float) -> None:
    pose = Pose()
    pose.orientation.w = bad
    with pytest.raises(CalibrationError, match="unit length"):
        conversions.pose_to_matrix(pose)
    with pytest.raises(ExecutionError, match="1 of 2 others, the first at 1"):
        conversions.poses_to_matrices([Pose(), pose])


def test_a_tool_path_survives_the_cloud() -> None:
    matrices = poses(4)
    rows = conversions.tool_path(
        matrices, np.array([0, 0, 1, 1]), np.array([True, False, True, True]), np.full(4, 5e-3), np.zeros(4), np.ones(4)
    )
    message = conversions.to_cloud(rows, 9, "tool0")
    assert (message.width, message.height, message.point_step) == (4, 1, conversions.TOOL_PATH.itemsize)
    assert [field.name for field in message.fields][:7] == ["x", "y", "z", "qx", "qy", "qz", "qw"]
    np.testing.assert_array_equal(conversions.cloud_to_tool_path(message), rows)
    np.testing.assert_allclose(rows["x"], matrices[:, 0, 3], rtol=1e-6)
    assert rows["laser_on"].tolist() == [1, 0, 1, 1]


def test_a_cloud_with_a_number_that_is_none_is_not_dense() -> None:
    rows = np.zeros(3, conversions.TOOL_PATH)
    assert conversions.to_cloud(rows, 0, "tool0").is_dense
    assert conversions.to_cloud(rows[:0], 0, "tool0").is_dense
    for name in ("residual", "confidence"):  # what leads carry
        lead = rows.copy()
        lead[name][1] = np.nan
        assert not conversions.to_cloud(lead, 0, "tool0").is_dense


def test_another_cloud_is_no_tool_path() -> None:
    message = conversions.to_cloud(np.zeros(2, [("x", "<f4"), ("y", "<f4")]), 0, "tool0")
    with pytest.raises(ExecutionError, match="expected a tool path of little-endian rows"):
        conversions.cloud_to_tool_path(message)
    cut = conversions.to_cloud(np.zeros(2, conversions.TOOL_PATH), 0, "tool0")
    cut.data = cut.data[:-1]
    with pytest.raises(ExecutionError, match="bytes"):
        conversions.cloud_to_tool_path(cut)


@pytest.mark.parametrize("what", ["float64", "swapped", "big-endian", "wider rows"])
def test_a_tool_path_of_another_layout_is_told_from_ours(what: str) -> None:
    kind = conversions.TOOL_PATH
    if what == "float64":
        kind = np.dtype([(name, "<u4" if name == "segment" else "<f4") for name in kind.names])
    elif what == "swapped":
        kind = np.dtype([(name, kind[name]) for name in ("y", "x", *kind.names[2:])])
    message = conversions.to_cloud(np.zeros(2, kind), 0, "tool0")
    if what == "float64":
        for column in message.fields:
            column.datatype = PointField.FLOAT64
    message.is_bigendian = what == "big-endian"
    message.point_step += what == "wider rows"
    with pytest.raises(ExecutionError, match=r"little-endian rows of 45 bytes .* got (big|little)-endian rows of \d+"):
        conversions.cloud_to_tool_path(message)


@pytest.mark.parametrize(("name", "value"), [("x", np.nan), ("z", np.inf), ("qw", 1.1), ("qy", np.nan)])
def test_a_tool_path_with_a_pose_that_is_none_is_refused(name: str, value: float) -> None:
    rows = conversions.tool_path(poses(3), *np.ones((5, 3)))
    np.testing.assert_allclose(conversions.tool_path_poses(rows), poses(3), atol=1e-6)
    rows[name][1] = value
    with pytest.raises(ExecutionError, match="finite poses with unit quaternions, got 1 of 3 others, the first at 1"):
        conversions.tool_path_poses(rows)


def test_the_grid_has_square_cells_over_the_ascans() -> None:
    geometry = VolumeGeometry((5, 4, 9), (28e-6, 14e-6, 14e-6), (1e-3, 2e-3, 0.0))
    view = np.zeros((5, 9), np.float32)
    view[3, 2] = 1.0
    grid = conversions.to_grid(view, geometry, 11)
    assert grid.info.resolution == pytest.approx(14e-6)
    assert (grid.info.width, grid.info.height) == (9, 9)
    cells = np.array(grid.data).reshape(9, 9)
    assert cells.max() == 100
    assert cells.min() == 0
    row, column = np.argwhere(cells == 100)[0]
    # The corner of the grid plus half a cell is the centre of the first cell.
    x = grid.info.origin.position.x + (column + 0.5) * grid.info.resolution
    y = grid.info.origin.position.y + (row + 0.5) * grid.info.resolution
    assert x == pytest.approx(1e-3 + 2 * 14e-6)
    assert abs(y - (2e-3 + 3 * 28e-6)) <= 14e-6
    assert grid.header.frame_id == geometry.frame


def test_a_grid_never_grows_beyond_its_limit() -> None:
    geometry = VolumeGeometry((512, 2, 512), (1e-3, 1e-6, 1e-6))
    grid = conversions.to_grid(np.ones((512, 512), np.float32), geometry, 0)
    assert grid.info.width * grid.info.height <= 1.05 * conversions.LARGEST_GRID


def test_a_field_message_names_its_format() -> None:
    message = conversions.to_field_message(b"abc", 5, "oct_optical_frame")
    assert message.format == field.FORMAT == conversions.FORMAT
    assert conversions.field_data(message) == b"abc"
    with pytest.raises(CheckpointError, match="got 'jpeg'"):
        conversions.field_data(CompressedImage(format="jpeg"))
