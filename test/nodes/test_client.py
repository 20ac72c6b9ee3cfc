"""The client of the graph: what it keeps, and what it lets go."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
from rclpy.node import Node
from std_srvs.srv import Trigger

from octn_ros.nodes.client import Watch

TIMEOUT_S, SHORT_S = 120.0, 0.1


def test_a_watch_keeps_the_last_messages_and_counts_all() -> None:
    watch: Watch[int] = Watch("numbers", lambda: 1, keep=2)
    for number in range(5):
        watch.add(number)
    assert watch.messages == [3, 4]
    assert watch.wait(SHORT_S) == 3
    assert watch.wait(SHORT_S, after=4) == 4
    asked: list[int] = []
    with pytest.raises(TimeoutError, match="5 messages came"):
        watch.wait(SHORT_S, asked.append)
    assert asked == [3, 4]
    threading.Timer(SHORT_S, watch.add, [5]).start()
    assert watch.wait(TIMEOUT_S, after=5) == 5


def test_a_watch_that_is_not_told_otherwise_keeps_everything() -> None:
    watch: Watch[int] = Watch("numbers", lambda: 1)
    for number in range(1000):
        watch.add(number)
    assert watch.messages == list(range(1000))


def test_a_request_that_is_not_answered_in_time_is_not_kept(spin: Callable[..., Any], client: Any) -> None:
    held = threading.Event()

    class Mute(Node):
        """Answers when it is told to."""

        def __init__(self, **options: Any) -> None:
            super().__init__("mute", namespace="octn", **options)
            self.create_service(Trigger, "wait", self._wait)

        def _wait(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            assert held.wait(TIMEOUT_S)
            response.success = True
            return response

    spin(Mute)
    with pytest.raises(TimeoutError, match="service wait"):
        client.call(Trigger, "wait", Trigger.Request(), 1.0)
    own = vars(client._clients["wait"])
    pending = own["_pending_requests"] if "_pending_requests" in own else own["_pending"]
    assert not pending
    held.set()
    assert client.call(Trigger, "wait", Trigger.Request(), TIMEOUT_S).success
