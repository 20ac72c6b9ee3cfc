"""Several processes on one machine, without a router."""

import signal
import time

import pytest
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

WAIT_SEC = 120.0
EXIT_SEC = 2.0


def said(process):
    line = process.stdout.readline().strip()
    assert line, process.stderr.read()
    return line


def call(node, kind, name, request, spin_until):
    client = node.create_client(kind, name)
    assert client.wait_for_service(WAIT_SEC), f"{name} did not come within {WAIT_SEC} s"
    future = client.call_async(request)
    spin_until(future.done, node)
    return future.result()


def test_another_process_gets_latched_messages_calls_services_and_sets_parameters(program, nodes, spin_until):
    assert said(program("server.py")) == "ready"
    node = nodes("client")
    paths = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Path, "path", paths.append, latched)
    spin_until(lambda: paths, node)
    assert [len(p.poses) for p in paths] == [3], "only the last of two latched messages is kept"

    request = GetPlan.Request()
    request.start.header.frame_id = "oct"
    plan = call(node, GetPlan, "plan", request, spin_until).plan
    assert plan.header.frame_id == "oct!"
    assert len(plan.poses) == 1000

    def set_gain(value):
        message = Parameter("gain", value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return call(node, SetParameters, "server/set_parameters", request, spin_until).results[0]

    assert set_gain(2.5).successful
    refused = set_gain(9.0)
    assert not refused.successful
    assert "out of range" in refused.reason
    got = call(node, GetParameters, "server/get_parameters", GetParameters.Request(names=["gain"]), spin_until)
    assert got.values[0].double_value == 2.5
    names = call(node, ListParameters, "server/list_parameters", ListParameters.Request(), spin_until).result.names
    assert set(names) == {"gain", "use_sim_time"}
    request = DescribeParameters.Request(names=["gain"])
    told = call(node, DescribeParameters, "server/describe_parameters", request, spin_until).descriptors[0]
    assert told.type == ParameterType.PARAMETER_DOUBLE
    assert told.floating_point_range[0].to_value == 5.0


@pytest.mark.parametrize("executor", ["single", "threads"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_node_in_order(program, number, executor):
    process = program("server.py", executor)
    assert said(process) == "ready"
    start = time.monotonic()
    process.send_signal(number)
    _, errors = process.communicate(timeout=WAIT_SEC)
    assert (process.returncode, errors) == (0, "")
    assert time.monotonic() - start < EXIT_SEC


def test_two_new_processes_meet_after_the_holder_of_the_port_was_killed(program):
    holder = program("peer.py", "holder")
    assert said(holder) == "met"  # alone, so the port is its own
    survivor = program("peer.py", "survivor", "holder")
    assert said(survivor) == "met"
    holder.kill()
    late = [program("peer.py", "late_one", "late_two", "survivor"), program("peer.py", "late_two", "late_one")]
    assert [said(p) for p in late] == ["met", "met"]


def test_a_killed_server_leaves_the_graph_and_another_takes_its_place(program, nodes, spin_until):
    node = nodes("client")
    client = node.create_client(GetPlan, "plan")
    for _ in range(2):
        server = program("server.py")
        assert said(server) == "ready"
        assert client.wait_for_service(WAIT_SEC)
        future = client.call_async(GetPlan.Request())
        spin_until(future.done, node)
        server.kill()
        spin_until(lambda: not client.service_is_ready(), node)
