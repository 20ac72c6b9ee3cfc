"""A client of the graph: calls services and waits for messages, from plain sequential code."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any, Generic, TypeVar

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from octn_ros.nodes import qos
from octn_ros.nodes.background import BackgroundSpin

Message = TypeVar("Message")

_GRAPH_PERIOD_S = 0.02  # rclpy tells nobody when the graph changes, so it is looked at


class Watch(Generic[Message]):
    """What was heard on one topic since it is watched; safe from any thread.

    Args:
        topic: its name.
        publishers: tells how many publishers are connected.
        keep: so many of the last messages are kept, None for all of them.
    """

    def __init__(self, topic: str, publishers: Callable[[], int], keep: int | None = None) -> None:
        self._topic, self._publishers = topic, publishers
        self._messages: deque[Message] = deque(maxlen=keep)
        self._heard = 0
        self._condition = threading.Condition()

    @property
    def messages(self) -> list[Message]:
        """The messages so far that are kept, oldest first."""
        with self._condition:
            return list(self._messages)

    def add(self, message: Message) -> None:
        """Take a message; the subscription's callback."""
        with self._condition:
            self._messages.append(message)
            self._heard += 1
            self._condition.notify_all()

    def wait(
        self, timeout_s: float, accept: Callable[[Message], bool] = lambda message: True, *, after: int = 0
    ) -> Message:
        """Return the first message, kept already or still to come, that `accept` says yes to.

        Args:
            timeout_s: for it to come.
            accept: asked for each message once, in their order.
            after: so many of the first messages that were heard do not count.

        Raises:
            TimeoutError: names the topic and how many other messages came.
        """
        deadline = time.monotonic() + timeout_s
        seen = after
        with self._condition:
            while True:
                gone = self._heard - len(self._messages)
                for message in list(self._messages)[max(seen - gone, 0) :]:
                    if accept(message):
                        return message
                seen = max(seen, self._heard)
                left = deadline - time.monotonic()
                if left <= 0.0:
                    raise TimeoutError(f"{self._topic}: {timeout_s:g} s passed, {seen} messages came, none as awaited")
                self._condition.wait(left)

    def wait_matched(self, timeout_s: float) -> None:
        """Return once a publisher of the topic is connected.

        Raises:
            TimeoutError: names the topic.
        """
        wait_graph(lambda: self._publishers() > 0, timeout_s, f"{self._topic}: no publisher")


class GraphClient:
    """A node that spins in a thread of its own, so that the caller's code can wait; a context manager.

    rclpy must be initialised. Methods may be called from any thread but the client's own.

    Args:
        name: the node's name.
        namespace: where relative names of services and topics are looked for.
    """

    def __init__(self, name: str = "client", namespace: str = "octn") -> None:
        self.node = Node(name, namespace=namespace)
        self._clients: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._spin = BackgroundSpin(self._executor, name)

    def __enter__(self) -> GraphClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph."""
        self._spin.stop()
        self._executor.shutdown()
        self.node.destroy_node()

    def call(self, kind: Any, name: str, request: Any, timeout_s: float) -> Any:
        """Call a service, waiting for it to be there, and return its response.

        Args:
            kind: the service's type.
            name: its name, relative to the namespace.
            request: the request, `kind.Request(...)`.
            timeout_s: for the service to appear, and again for its answer.

        Raises:
            TimeoutError: names the service and what did not happen.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name, qos_profile=qos.SERVICES)
        client = self._clients[name]
        if not client.wait_for_service(timeout_s):
            raise TimeoutError(f"service {name}: not there after {timeout_s:g} s; is its node running?")
        answered = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda done: answered.set())
        if not answered.wait(timeout_s):
            client.remove_pending_request(future)  # else each lost request is kept for good
            raise TimeoutError(f"service {name}: no answer after {timeout_s:g} s")
        return future.result()

    def wait_for(self, happened: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Return once the graph is as awaited, a publisher of the client's own has met its subscriber for instance.

        Raises:
            TimeoutError: says `what` was not there.
        """
        wait_graph(happened, timeout_s, f"{what}: not there")

    def watch(self, kind: Any, topic: str, profile: QoSProfile = qos.LATCHED, *, keep: int | None = None) -> Watch[Any]:
        """Collect what is heard on a topic from now on, and its latched message if it has one.

        Args:
            kind: the message's type.
            topic: its name, relative to the namespace.
            profile: quality of service.
            keep: so many of the last messages are kept, None for all; large ones, such as fields, fill the memory.
        """
        subscription: list[Any] = []
        watch: Watch[Any] = Watch(topic, lambda: subscription[0].get_publisher_count(), keep)
        subscription.append(self.node.create_subscription(kind, topic, watch.add, profile))
        return watch


def wait_graph(happened: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
    """Return once something has happened in the graph, which is looked at again and again.

    Raises:
        TimeoutError: in the words of `otherwise`.
    """
    deadline = time.monotonic() + timeout_s
    pause = threading.Event()
    while not happened():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{otherwise} after {timeout_s:g} s")
        pause.wait(_GRAPH_PERIOD_S)
