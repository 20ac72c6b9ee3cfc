"""Publishers and subscriptions in one process."""

import pytest
import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    InvalidQoSProfileException,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from std_msgs.msg import Int32, String

from octn_ros.embedded import message
from octn_ros.embedded.errors import InvalidHandle, RCLError

LATCHED = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


def numbers(count):
    return [Int32(data=i) for i in range(count)]


def test_messages_arrive_in_order(nodes, spin_until):
    node, got = nodes("alpha"), []
    node.create_subscription(Int32, "numbers", lambda m: got.append(m.data), 100)
    publisher = node.create_publisher(Int32, "numbers", 100)
    for number in numbers(50):
        publisher.publish(number)
    spin_until(lambda: len(got) == 50, node)
    assert got == list(range(50))
    assert publisher.topic_name == "/numbers"


def test_the_oldest_messages_are_dropped_when_the_queue_is_full(nodes, spin_until):
    node, last, every = nodes("alpha"), [], []
    node.create_subscription(Int32, "numbers", lambda m: last.append(m.data), 3)
    keep_all = QoSProfile(history=HistoryPolicy.KEEP_ALL)
    node.create_subscription(Int32, "numbers", lambda m: every.append(m.data), keep_all)
    publisher = node.create_publisher(Int32, "numbers", 10)
    for number in numbers(10):
        publisher.publish(number)
    spin_until(lambda: len(every) == 10, node)
    assert last == [7, 8, 9]


def test_late_joiners_get_the_last_messages_of_a_latched_topic_only(nodes, spin_until):
    node, late, volatile = nodes("alpha"), [], []
    publisher = node.create_publisher(Int32, "latched", LATCHED)
    for number in numbers(5):
        publisher.publish(number)
    node.create_subscription(Int32, "latched", lambda m: volatile.append(m.data), 10)
    node.create_subscription(Int32, "latched", lambda m: late.append(m.data), LATCHED)
    spin_until(lambda: len(late) == 2, node)
    publisher.publish(Int32(data=5))
    spin_until(lambda: len(late) == 3 and volatile, node)
    assert (late, volatile) == ([3, 4, 5], [5])


def test_a_message_may_be_published_as_its_bytes(nodes, spin_until):
    node, got = nodes("alpha"), []
    node.create_subscription(String, "text", got.append, 10)
    node.create_publisher(String, "text", 10).publish(message.serialize(String(data="one")))
    spin_until(lambda: got, node)
    assert got == [String(data="one")]


def test_bytes_that_are_no_message_are_an_error_and_the_node_goes_on(nodes, spin_until):
    node, got = nodes("alpha"), []
    node.create_subscription(String, "text", got.append, 10)
    publisher = node.create_publisher(String, "text", 10)
    publisher.publish(b"no message")
    with pytest.raises(ValueError, match="little-endian"):
        spin_until(lambda: got, node)
    publisher.publish(String(data="one"))
    spin_until(lambda: got, node)
    assert got[0].data == "one"


def test_the_graph_tells_who_is_there(nodes, spin_until):
    node, other = nodes("alpha"), nodes("beta", namespace="rob")
    assert node.wait_for_node("/rob/beta", 5.0)
    assert not node.wait_for_node("/rob/gamma", 0.0)
    publisher = node.create_publisher(String, "/text", qos_profile_sensor_data)
    subscription = other.create_subscription(String, "/text", print, qos_profile_sensor_data)
    assert publisher.get_subscription_count() == subscription.get_publisher_count() == 1
    assert (node.count_publishers("/text"), other.count_subscribers("/text")) == (1, 1)
    assert other.destroy_subscription(subscription)
    assert not other.destroy_subscription(subscription)
    other.destroy_node()
    assert publisher.get_subscription_count() == 0
    assert not node.wait_for_node("/rob/beta", 0.0)


def test_remaps_and_namespaces(init, nodes):
    init("-r", "in:=/elsewhere", "-r", "beta:out:=side", "-r", "__ns:=/rob")
    alpha, beta = nodes("alpha"), nodes("beta", namespace="ignored")
    assert beta.get_fully_qualified_name() == "/rob/beta"
    assert alpha.resolve_topic_name("in") == "/elsewhere"
    assert alpha.resolve_topic_name("in", only_expand=True) == "/rob/in"
    assert (alpha.resolve_topic_name("out"), beta.resolve_topic_name("out")) == ("/rob/out", "/rob/side")
    assert alpha.resolve_topic_name("~/x") == "/rob/alpha/x"
    with pytest.raises(NotImplementedError, match=r"substitution .* needs ROS 2"):
        alpha.resolve_topic_name("/abs/{node}")
    assert alpha.resolve_service_name("in") == "/elsewhere"


def test_a_node_is_renamed_and_may_ignore_the_arguments(init, nodes):
    init("-r", "alpha:__node:=gamma", "-p", "rate:=1.0")
    renamed, alone = nodes("alpha"), nodes("delta", use_global_arguments=False)
    assert renamed.get_name() == "gamma"
    assert [n.declare_parameter("rate", 0.0).value for n in (renamed, alone)] == [1.0, 0.0]


@pytest.mark.parametrize("topic", ["", "two words", "ends/", "1digit", "a//b", "~x/1"])
def test_wrong_topic_names_are_refused(nodes, topic):
    with pytest.raises(InvalidTopicNameException):
        nodes("alpha").create_publisher(String, topic, 1)


def test_wrong_arguments_are_refused(nodes):
    node = nodes("alpha")
    publisher = node.create_publisher(String, "a", 1)
    with pytest.raises(TypeError, match="Expected"):
        publisher.publish(Int32())
    with pytest.raises(TypeError, match="QoSProfile or int"):
        node.create_publisher(String, "a", "ten")
    with pytest.raises(ValueError, match="-1"):
        node.create_publisher(String, "a", -1)
    with pytest.raises(RuntimeError, match="no message or service class"):
        node.create_publisher(str, "a", 1)
    for callback in (lambda: None, lambda text, info: None):
        with pytest.raises(NotImplementedError, match=r"other than one argument, .* needs ROS 2"):
            node.create_subscription(String, "a", callback, 1)
    with pytest.raises(InvalidQoSProfileException):
        QoSProfile(history=HistoryPolicy.KEEP_LAST)
    with pytest.raises(InvalidQoSProfileException):
        QoSProfile(reliability=ReliabilityPolicy.RELIABLE)


def test_publishing_ends_with_publisher_and_context(nodes):
    node = nodes("alpha")
    publisher, other = node.create_publisher(String, "a", 1), node.create_publisher(String, "b", 1)
    node.destroy_publisher(publisher)
    with pytest.raises(InvalidHandle):
        publisher.publish(String())
    rclpy.shutdown()
    with pytest.raises(RCLError):
        other.publish(String())


def test_a_raw_subscription_gets_the_encoded_message(nodes, spin_until):
    node, got = nodes("alpha"), []
    node.create_subscription(String, "words", got.append, 10, raw=True)
    node.create_publisher(String, "words", 10).publish(String(data="hello"))
    spin_until(lambda: got, node)
    assert got == [b"\x00\x01\x00\x00" + b"\x06\x00\x00\x00hello\x00"]


def test_a_node_lists_what_it_has_made(nodes):
    node = nodes("alpha")
    publisher = node.create_publisher(Int32, "numbers", 10)
    subscription = node.create_subscription(Int32, "numbers", print, LATCHED)
    assert [entity.topic_name for entity in node.publishers] == ["/parameter_events", "/numbers"]
    assert list(node.subscriptions) == [subscription]
    assert subscription.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert "/alpha/set_parameters" in {entity.service_name for entity in node.services}
    node.destroy_publisher(publisher)
    assert [entity.topic_name for entity in node.publishers] == ["/parameter_events"]
