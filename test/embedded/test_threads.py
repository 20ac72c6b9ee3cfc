"""Entities destroyed, and contexts shut down, while other threads use them."""

import threading

import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import Trigger

from octn_ros.embedded.errors import InvalidHandle, RCLError

ROUNDS = 8
WAIT_SEC = 120.0
LARGE = UInt8MultiArray(data=bytes(1 << 20))  # takes long enough to send that it is nearly always on its way
DURABILITIES = [DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL]


@pytest.fixture
def publishing(nodes):
    """A publisher, the thread that publishes with it until an error ends it, and the list that gets the error."""

    def start(durability):
        publisher = nodes("alpha").create_publisher(
            UInt8MultiArray, "large", QoSProfile(depth=1, durability=durability)
        )
        going, errors = threading.Event(), []

        def publish():
            try:
                while True:
                    publisher.publish(LARGE)
                    going.set()
            except Exception as error:
                errors.append(error)

        thread = threading.Thread(target=publish)
        thread.start()
        assert going.wait(WAIT_SEC), errors
        return publisher, thread, errors

    return start


@pytest.mark.parametrize("durability", DURABILITIES)
def test_a_publisher_is_destroyed_while_another_thread_publishes(publishing, durability):
    for _ in range(ROUNDS):
        publisher, thread, errors = publishing(durability)
        try:
            publisher.destroy()
        finally:
            rclpy.shutdown()  # ends the thread also where the publisher was not destroyed
            thread.join(WAIT_SEC)
        assert [type(e) for e in errors] == [InvalidHandle]


@pytest.mark.parametrize("durability", DURABILITIES)
def test_a_context_is_shut_down_while_another_thread_publishes(publishing, durability):
    for _ in range(ROUNDS):
        _, thread, errors = publishing(durability)
        rclpy.shutdown()
        thread.join(WAIT_SEC)
        assert [type(e) for e in errors] == [RCLError]


def test_many_threads_destroy_one_entity(nodes):
    node = nodes("alpha")
    for _ in range(ROUNDS):
        entities = [node.create_publisher(UInt8MultiArray, "large", 1), node.create_client(Trigger, "ask")]
        gate, errors = threading.Barrier(4), []

        def destroy(entities=entities, gate=gate, errors=errors):
            gate.wait(WAIT_SEC)
            try:
                for entity in entities:
                    entity.destroy()
            except Exception as error:
                errors.append(error)

        threads = [threading.Thread(target=destroy) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(WAIT_SEC)
        assert not errors
    assert node.count_publishers("large") == 0
