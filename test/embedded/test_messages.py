"""Message objects behave as those that rosidl generates."""

import copy
import pickle
import subprocess
import sys
from array import array
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseArray, PoseWithCovariance, Quaternion
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetPlan, LoadMap
from sensor_msgs.msg import CameraInfo, NavSatStatus, PointCloud2, PointField
from std_msgs.msg import Bool, Byte, Empty, Float32, Float64MultiArray, Header, Int8, String, UInt8MultiArray
from std_srvs.srv import Trigger

ROOT = Path(__file__).parents[2]


def test_defaults_are_nested():
    pose = Pose()
    assert (pose.position.x, pose.orientation.w) == (0.0, 1.0)
    assert Pose().position is not pose.position
    assert NavSatStatus().status == -2
    assert PoseWithCovariance().covariance.dtype == np.float64
    assert OccupancyGrid().data == array("b")
    assert DiagnosticStatus().level == b"\0"


def test_constants():
    assert PointField.FLOAT32 == 7
    assert DiagnosticStatus.WARN == b"\x01"
    assert LoadMap.Response.RESULT_INVALID_MAP_DATA == 2


def test_fields_and_repr():
    with pytest.raises(NotImplementedError, match=r"get_fields_and_field_types .* needs ROS 2"):
        GetPlan.Request().get_fields_and_field_types()
    assert repr(Header(frame_id="map")) == (
        "std_msgs.msg.Header(stamp=builtin_interfaces.msg.Time(sec=0, nanosec=0), frame_id='map')"
    )
    assert repr(UInt8MultiArray(data=[1, 2])).endswith("data=[1, 2])")
    assert repr(Empty()) == "std_msgs.msg.Empty()"


@pytest.mark.parametrize(
    ("cls", "values"),
    [
        (Point, {"x": 1}),
        (Point, {"x": "1"}),
        (Point, {"q": 1.0}),
        (Float32, {"data": 1e39}),
        (Int8, {"data": 128}),
        (Bool, {"data": 1}),
        (Bool, {"data": np.True_}),
        (Byte, {"data": 1}),
        (Byte, {"data": b"ab"}),
        (String, {"data": b"text"}),
        (Header, {"stamp": 3}),
        (PoseArray, {"poses": [1]}),
        (PoseArray, {"poses": "ab"}),
        (PoseArray, {"poses": None}),
        (PoseWithCovariance, {"covariance": [0.0] * 35}),
        (PoseWithCovariance, {"covariance": np.zeros((6, 6))}),
        (PoseWithCovariance, {"covariance": np.zeros(36, np.float32)}),
        (UInt8MultiArray, {"data": np.zeros(2, np.int16)}),
        (UInt8MultiArray, {"data": [256]}),
        (UInt8MultiArray, {"data": "ab"}),
        (OccupancyGrid, {"data": b"ab"}),
        (Float64MultiArray, {"data": bytes(8)}),
        (Float64MultiArray, {"data": [None]}),
    ],
)
def test_wrong_values_are_refused(cls, values):
    with pytest.raises(AssertionError, match=next(iter(values))):
        cls(**values)


def test_setters_check_too_and_there_are_no_other_attributes():
    point = Point()
    with pytest.raises(AssertionError, match="'x' field of geometry_msgs/msg/Point must be of type 'float', got 1"):
        point.x = 1
    with pytest.raises(AttributeError):
        point.w = 1.0
    assert Point.__slots__ == ["_x", "_y", "_z"]


@pytest.mark.parametrize("given", [b"ab", bytearray(b"ab"), memoryview(b"ab"), [97, 98], np.array([97, 98], np.uint8)])
def test_uint8_sequences_take_bytes_lists_and_arrays(given):
    message = UInt8MultiArray(data=given)
    assert message.data == array("B", b"ab")
    assert isinstance(message.data, array)


def test_an_array_of_the_right_type_is_kept_without_a_copy():
    values = array("B", b"ab")
    assert UInt8MultiArray(data=values).data is values


def test_fixed_arrays_may_be_views():
    from octn_ros.embedded import message

    info = CameraInfo(k=np.arange(18.0)[::2])
    assert message.deserialize(message.serialize(info), CameraInfo).k[8] == 16.0


def test_equality_copies_and_no_hash():
    message = PoseArray(header=Header(frame_id="map"), poses=[Pose(position=Point(x=2.0))])
    other = copy.deepcopy(message)
    assert other == message
    assert other.poses[0] is not message.poses[0]
    other.poses[0].position.x = 3.0
    assert other != message
    assert message != Point()
    assert PoseWithCovariance() == PoseWithCovariance()
    with pytest.raises(TypeError):
        hash(message)


@pytest.mark.parametrize("message", [Quaternion(x=0.5), CameraInfo(), Trigger.Response(message="ok"), PointCloud2()])
def test_pickle(message):
    assert pickle.loads(pickle.dumps(message)) == message


def test_a_pickle_is_read_by_a_process_that_has_imported_no_messages():
    code = (
        "import octn_ros.embedded, pickle, sys; octn_ros.embedded.install();"
        f"print(pickle.loads({pickle.dumps(Header(frame_id='map'))!r}).frame_id)"
    )
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "map"


def test_classes_lie_where_rosidl_puts_them():
    from sensor_msgs.msg._point_cloud2 import PointCloud2 as Same
    from std_srvs.srv._trigger import Trigger_Request

    assert Same is PointCloud2
    assert PointCloud2.__module__ == "sensor_msgs.msg._point_cloud2"
    assert Trigger_Request is Trigger.Request


def test_unknown_names_are_missing():
    with pytest.raises(ImportError):
        from std_msgs.msg import Nothing  # noqa: F401
    with pytest.raises(ImportError):
        import std_msgs.msg._nothing
    with pytest.raises(ImportError):
        import std_msgs.action  # noqa: F401


def test_a_message_asked_to_check_its_fields_keeps_an_array_that_is_assigned():
    from sensor_msgs.msg import CompressedImage

    data = array("B", b"abc")
    message = CompressedImage(format="png", check_fields=True)
    message.data = data
    assert message.data is data
    assert message == CompressedImage(format="png", data=data)
    with pytest.raises(AssertionError, match="Invalid arguments"):
        CompressedImage(check_fields=True, nonsense=1)
