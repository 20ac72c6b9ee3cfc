"""/tf and /tf_static, put together as tf2 does it, against places that are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, TransformStamped
from tf2_msgs.msg import TFMessage

from octn_ros.nodes import conversions, qos
from octn_ros.nodes.planner import Planner
from octn_ros.planning import from_translation_quaternion, load_calibration
from octn_ros.resources import config_path
from octn_ros.simulation import PhantomConfig, Scanner, make_phantom

TIMEOUT_S = 120.0
ARM = from_translation_quaternion((0.4, -0.1, 0.3), (0.5, 0.5, -0.5, 0.5))


def matrix(transform: TransformStamped) -> np.ndarray:
    """What maps points of the child frame into the header's."""
    place, turn = transform.transform.translation, transform.transform.rotation
    return from_translation_quaternion((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def tree(*messages: TFMessage) -> dict[str, TransformStamped]:
    """The transforms by child frame: a tree, so there is one parent for each."""
    return {transform.child_frame_id: transform for message in messages for transform in message.transforms}


def to_root(frames: dict[str, TransformStamped], frame: str) -> np.ndarray:
    """What maps points of a frame into the root's, the product along the way up."""
    found = np.eye(4)
    while frame in frames:
        found, frame = matrix(frames[frame]) @ found, frames[frame].header.frame_id
    return found


@pytest.fixture
def graph(spin: Callable[..., Any], client: Any) -> Any:
    """A planner and an arm that stands still."""

    class Graph:
        static = client.watch(TFMessage, "/tf_static")
        moving = client.watch(TFMessage, "/tf", qos.TRANSFORMS)
        ee_pose = client.node.create_publisher(PoseStamped, "ee_pose", qos.STREAM)
        asked = client
        make = staticmethod(spin)

        def say(self, ee2base: np.ndarray, stamp_ns: int, frame: str = "base_link") -> None:
            self.ee_pose.publish(conversions.matrix_to_pose_stamped(ee2base, stamp_ns, frame))

        def start(self, **parameters: Any) -> Any:
            node = spin(Planner, device="cpu", **parameters)
            client.wait_for(lambda: self.ee_pose.get_subscription_count() > 0, TIMEOUT_S, "planner")
            self.moving.wait_matched(TIMEOUT_S)
            return node

    return Graph()


def test_a_point_of_the_scan_is_where_calibration_and_arm_put_it(graph: Any) -> None:
    graph.start()
    graph.say(ARM, 7_000_000_123)
    moving = graph.moving.wait(TIMEOUT_S)
    frames = tree(graph.static.wait(TIMEOUT_S), moving)
    calibration = load_calibration(config_path("calibration.yaml"))
    point = np.array([1.1e-3, 0.4e-3, 0.9e-3, 1.0])
    np.testing.assert_allclose(
        to_root(frames, "oct_optical_frame") @ point, ARM @ calibration.oct2ee @ point, atol=1e-12
    )
    np.testing.assert_allclose(to_root(frames, "laser_frame"), ARM @ calibration.laser2ee, atol=1e-12)
    (transform,) = moving.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "tool0")
    assert conversions.stamp_to_ns(transform.header.stamp) == 7_000_000_123


def test_the_bscan_frame_is_that_of_the_first_image(graph: Any) -> None:
    graph.start()
    frames = tree(graph.static.wait(TIMEOUT_S))
    bscan = next(Scanner(make_phantom(PhantomConfig(shape=(2, 8, 8))).volume).bscans(0, 1))
    assert frames["oct_bscan_frame"].header.frame_id == "oct_optical_frame"
    np.testing.assert_allclose(matrix(frames["oct_bscan_frame"]), bscan.image2oct, atol=1e-15)
    # x lateral, y down the A-scan, z against the slow scan
    one_down = matrix(frames["oct_bscan_frame"]) @ (0.0, 1.0, 0.0, 1.0)
    np.testing.assert_allclose(one_down, (0.0, 0.0, 1.0, 1.0), atol=1e-15)


def test_poses_that_say_nothing_are_left_out(graph: Any) -> None:
    node = graph.start()
    lame = conversions.matrix_to_pose_stamped(ARM, 1, "base_link")
    lame.pose.orientation.w = float("nan")
    graph.ee_pose.publish(lame)
    late = conversions.matrix_to_pose_stamped(ARM, 0, "base_link")
    late.header.stamp.sec, late.header.stamp.nanosec = 2**31 - 1, 2**32 - 1  # no message has room for both together
    graph.ee_pose.publish(late)
    graph.say(ARM, 2, "another_base")
    graph.say(ARM, 3)
    graph.say(ARM, 3)
    graph.say(ARM, 4)
    graph.moving.wait(TIMEOUT_S, lambda message: message.transforms[0].header.stamp.nanosec == 4)
    assert [message.transforms[0].header.stamp.nanosec for message in graph.moving.messages] == [3, 4]
    assert node.get_name() == "planner"


def test_a_robot_that_publishes_its_own_pose_is_left_to_it(spin: Callable[..., Any], client: Any) -> None:
    node = spin(Planner, device="cpu", transforms__moving=False)
    static = client.watch(TFMessage, "/tf_static")
    assert "tool0" not in tree(static.wait(TIMEOUT_S))
    assert "/tf" not in {publisher.topic_name for publisher in node.publishers}
    assert "/octn/ee_pose" not in {subscription.topic_name for subscription in node.subscriptions}
