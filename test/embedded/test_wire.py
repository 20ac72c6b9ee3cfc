"""Tokens and hashes against those of a ROS 2 Jazzy graph with rmw_zenoh_cpp, and the session's configuration."""

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_parameter_events

from octn_ros.embedded import definitions, session, wire
from octn_ros.embedded.errors import RCLError
from octn_ros.embedded.wire import Token

SESSION = "943f9ebc32acd3e072bfda12ce8c7ed2"
NODE = "/_ros2cli_31"
GOLDEN = [
    (
        Token(wire.NODE, NODE),
        0,
        f"@ros2_lv/0/{SESSION}/0/0/NN/%/%/_ros2cli_31",
    ),
    (
        (wire.PUBLISHER, "/parameter_events", "rcl_interfaces/msg/ParameterEvent", qos_profile_parameter_events),
        2,
        f"@ros2_lv/0/{SESSION}/0/2/MP/%/%/_ros2cli_31/%parameter_events/rcl_interfaces::msg::dds_::ParameterEvent_/"
        "RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204/::,1000:,:,:,,",
    ),
    (
        (
            wire.PUBLISHER,
            "/rosout",
            "rcl_interfaces/msg/Log",
            QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10)),
        ),
        1,
        f"@ros2_lv/0/{SESSION}/0/1/MP/%/%/_ros2cli_31/%rosout/rcl_interfaces::msg::dds_::Log_/"
        "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac/:1:,1000:,:10,0:,,",
    ),
    (
        (
            wire.SUBSCRIPTION,
            "/cmd_vel",
            "geometry_msgs/msg/TwistStamped",
            QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
        ),
        4,
        f"@ros2_lv/0/{SESSION}/0/4/MS/%/%/_ros2cli_31/%cmd_vel/geometry_msgs::msg::dds_::TwistStamped_/"
        "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64/2::,1:,:,:,,",
    ),
]
HASHES = {  # some were published cut off
    "std_msgs/msg/Char": "3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "example_interfaces/srv/AddTwoInts": "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    "rcl_interfaces/srv/ListParameters": "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    "rcl_interfaces/srv/GetParameters": "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003",
    "rcl_interfaces/srv/DescribeParameters": "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e9",
    "rcl_interfaces/srv/SetParametersAtomically": "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
}


@pytest.mark.parametrize(("given", "entity_id", "golden"), GOLDEN)
def test_tokens_are_those_of_a_jazzy_graph(given, entity_id, golden):
    token = given
    if not isinstance(given, Token):
        kind, name, ros_type, qos = given
        names = definitions.dds_name(ros_type), definitions.type_hash(ros_type)
        token = Token(kind, NODE, name, *names, wire.qos_text(qos))
    assert token.key(0, SESSION, 0, entity_id) == golden
    assert Token.parse(golden) == token


@pytest.mark.parametrize("name", HASHES)
def test_type_hashes_are_those_of_jazzy(name):
    if name.startswith("example_interfaces"):
        definitions.add_service(name, "int64 a\nint64 b\n---\nint64 sum\n")
    assert definitions.type_hash(name).startswith(f"RIHS01_{HASHES[name]}")


def test_namespaces_and_keep_all_survive_a_token():
    qos = wire.qos_text(QoSProfile(history=HistoryPolicy.KEEP_ALL, deadline=Duration(seconds=1.5)))
    assert qos == "::2,:1,500000000:,:,,"
    token = Token(wire.SERVICE, "/rob/arm/node", "/rob/plan", "nav_msgs::srv::dds_::GetPlan_", "RIHS01_0", qos)
    assert Token.parse(token.key(3, SESSION, 1, 2)) == token
    assert token.topic_key(3) == "3/rob/plan/nav_msgs::srv::dds_::GetPlan_/RIHS01_0"
    with pytest.raises(ValueError, match="parts"):
        Token.parse("@ros2_lv/0/x")


def test_attachments_and_gids():
    gid = wire.gid("some token")
    assert len(gid) == 16
    sequence, stamp, sender = wire.unpack_attachment(wire.pack_attachment(7, gid))
    assert (sequence, sender) == (7, gid)
    assert stamp > 0


def test_a_session_listens_on_loopback_only(graph):
    config = session.session_config(int(graph["ROS_DOMAIN_ID"]))
    endpoints = config["listen/endpoints"] + config["connect/endpoints"]
    assert all(e.startswith("tcp/127.0.0.1:") for e in endpoints)
    assert endpoints[0].startswith(f"tcp/127.0.0.1:{graph['OCTN_RENDEZVOUS_PORT']}")
    assert not config["scouting/multicast/enabled"]


def test_the_port_follows_the_domain(monkeypatch):
    monkeypatch.delenv("OCTN_RENDEZVOUS_PORT")
    assert session.session_config(3)["listen/endpoints"][0].startswith("tcp/127.0.0.1:17450")


@pytest.mark.parametrize("text", ["80000", "0", "-1", "rviz", ""])
def test_what_is_no_port_is_refused(monkeypatch, text):
    monkeypatch.setenv("OCTN_RENDEZVOUS_PORT", text)
    with pytest.raises(RCLError, match=f"OCTN_RENDEZVOUS_PORT: expected a port, 1 to 65535, got '{text}'"):
        session.session_config(3)
