"""Services and clients in one process."""

import threading

import pytest
from nav_msgs.srv import GetPlan
from rclpy.exceptions import InvalidServiceNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

WAIT_SEC = 120.0
SHORT_SEC = 0.05


def flip(request, response):
    response.success = not request.data
    return response


def test_a_call_gets_its_own_answer(nodes, spin_until):
    node = nodes("alpha")
    node.create_service(SetBool, "flip", flip)
    client = node.create_client(SetBool, "flip")
    assert client.wait_for_service(WAIT_SEC)
    calls = [client.call_async(SetBool.Request(data=bool(i % 2))) for i in range(10)]
    spin_until(lambda: all(c.done() for c in calls), node)
    assert [c.result().success for c in calls] == [True, False] * 5


def test_a_client_knows_whether_its_service_is_there(nodes):
    node = nodes("alpha")
    client = node.create_client(SetBool, "flip")
    assert not client.service_is_ready()
    assert not client.wait_for_service(timeout_sec=SHORT_SEC)
    service = node.create_service(SetBool, "flip", flip)
    assert client.wait_for_service(WAIT_SEC)
    assert (service.service_name, client.service_name) == ("/flip", "/flip")
    node.destroy_service(service)
    assert not client.service_is_ready()


def test_waiting_ends_when_the_service_comes(nodes):
    node = nodes("alpha")
    client = node.create_client(SetBool, "flip")
    waiting = threading.Thread(target=lambda: found.append(client.wait_for_service(WAIT_SEC)))
    found = []
    waiting.start()
    node.create_service(SetBool, "flip", flip)
    waiting.join(WAIT_SEC)
    assert found == [True]


def test_a_blocking_call_while_another_thread_spins(nodes):
    node, executor = nodes("alpha"), SingleThreadedExecutor()
    node.create_service(SetBool, "flip", flip)
    client = node.create_client(SetBool, "flip")
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    assert client.call(SetBool.Request(data=False), timeout_sec=WAIT_SEC).success
    executor.shutdown()
    spinning.join(WAIT_SEC)
    assert client.call(SetBool.Request(), timeout_sec=SHORT_SEC) is None, "nobody spins: rclpy of Jazzy returns None"


def test_large_requests_and_answers(nodes, spin_until):
    node = nodes("alpha")

    def plan(request, response):
        response.plan.poses = [request.start] * 10_000
        return response

    node.create_service(GetPlan, "plan", plan)
    client = node.create_client(GetPlan, "plan")
    request = GetPlan.Request()
    request.start.pose.position.x = 2.5
    future = client.call_async(request)
    spin_until(future.done, node)
    assert future.result().plan.poses[-1].pose.position.x == 2.5


def test_mistakes_are_told(nodes, spin_until):
    node = nodes("alpha")
    client = node.create_client(SetBool, "flip")
    with pytest.raises(TypeError, match="Expected"):
        client.call_async(Trigger.Request())
    with pytest.raises(InvalidServiceNameException):
        node.create_service(SetBool, "two words", flip)
    node.create_service(SetBool, "flip", lambda request, response: None)
    future = client.call_async(SetBool.Request())
    with pytest.raises(TypeError, match="NoneType"):
        spin_until(future.done, node)


def test_a_forgotten_request_stays_open(nodes, spin_until):
    node = nodes("alpha")
    served = []
    node.create_service(Trigger, "do", lambda request, response: served.append(1) or response)
    client = node.create_client(Trigger, "do")
    future = client.call_async(Trigger.Request())
    client.remove_pending_request(future)
    other = client.call_async(Trigger.Request())
    spin_until(other.done, node)
    assert len(served) == 2
    assert not future.done()


def test_a_query_that_no_ros_client_sent_is_passed_over(nodes, spin_until):
    node, foreign = nodes("alpha"), []
    service = node.create_service(SetBool, "flip", flip)
    node.context._open_bus().session.get(service._endpoint.key, lambda reply: foreign.append(reply))
    client = node.create_client(SetBool, "flip")
    future = client.call_async(SetBool.Request())
    spin_until(future.done, node)
    assert future.result().success
    assert not foreign


def test_requests_that_wait_are_bounded_and_the_oldest_give_way(nodes, spin_until):
    node, served = nodes("alpha"), []

    def plan(request, response):
        served.append(request.tolerance)
        return response

    service = node.create_service(GetPlan, "plan", plan)
    client = node.create_client(GetPlan, "plan")
    assert service.qos_profile.depth == 10
    calls = [client.call_async(GetPlan.Request(tolerance=float(number))) for number in range(100)]
    spin_until(calls[-1].done, node)
    assert served == [float(number) for number in range(90, 100)], "nobody spun, so ten waited"
    assert [call.done() for call in calls] == [False] * 90 + [True] * 10


def test_a_deeper_profile_keeps_a_hundred_requests(nodes, spin_until):
    node = nodes("alpha")
    node.create_service(SetBool, "flip", flip, qos_profile=QoSProfile(depth=100))
    client = node.create_client(SetBool, "flip")
    calls = [client.call_async(SetBool.Request(data=False)) for _ in range(100)]
    spin_until(lambda: all(call.done() for call in calls), node)
    assert all(call.result().success for call in calls)
