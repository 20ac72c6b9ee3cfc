"""What an executor runs: entities with an inbox, which stand in the executor's queue while something is in it."""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from octn_ros.embedded.errors import needs_ros2

if TYPE_CHECKING:
    from octn_ros.embedded.rclpy.callback_groups import CallbackGroup
    from octn_ros.embedded.rclpy.executors import Executor
    from octn_ros.embedded.rclpy.node import Node
    from octn_ros.embedded.rclpy.qos import QoSProfile
    from octn_ros.embedded.transport import Endpoint

Work = Callable[[], Any]


class Inbox:
    """Bounded queue of what arrived for one entity; when it is full, the oldest item goes.

    `put` may be called from any thread and also from a signal handler. It takes no lock: Zenoh calls it in the thread
    that publishes, where that is in the same process.
    """

    def __init__(self, node: Node, depth: int | None = None) -> None:
        self.node = node
        self.entity: ReadyEntity | None = None
        self.posted: Executor | None = None  # the executor in whose queue the entity stands
        self._items: deque[Any] = deque(maxlen=depth)

    def put(self, item: Any) -> None:
        """Add an item and tell the node's executor."""
        self._items.append(item)
        self.notify()

    def notify(self) -> None:
        """Let the entity stand in its executor's queue, once, if there is something in its inbox."""
        executor = self.node.executor
        if self._items and executor is not None and self.entity is not None and self.posted is not executor:
            self.posted = executor
            executor._post(self.entity)

    def pop(self) -> Any:
        """Return the oldest item, or None."""
        try:
            return self._items.popleft()
        except IndexError:
            return None


class ReadyEntity:
    """Base of publishers, subscriptions, services, clients and timers."""

    def __init__(self, callback: Any, callback_group: CallbackGroup, inbox: Inbox) -> None:
        if inspect.iscoroutinefunction(callback):
            raise needs_ros2(f"a coroutine as callback, {callback!r},")
        self.callback, self.callback_group, self._inbox = callback, callback_group, inbox
        inbox.entity = self
        inbox.notify()  # of what arrived between the declaration and here

    def _take(self) -> Work | None:
        """Return what to run now, or None. Called by the executor while it holds the callback group."""
        raise NotImplementedError

    def destroy(self) -> None:
        """Withdraw the entity; use the `destroy_` methods of its node."""
        raise NotImplementedError


class Announced(ReadyEntity):
    """Base of those that others see in the graph: all but timers."""

    def __init__(self, endpoint: Endpoint, callback: Any, callback_group: CallbackGroup) -> None:
        self._endpoint = endpoint
        self.qos_profile: QoSProfile = endpoint.qos
        super().__init__(callback, callback_group, endpoint.inbox)

    def destroy(self) -> None:
        """Withdraw the entity; use the `destroy_` methods of its node."""
        self._endpoint.close()


class TopicEntity(Announced):
    """Base of publishers and subscriptions."""

    def __init__(self, endpoint: Endpoint, msg_type: Any, topic: str, callback: Any, group: CallbackGroup) -> None:
        self.msg_type, self.topic = msg_type, topic
        super().__init__(endpoint, callback, group)

    @property
    def topic_name(self) -> str:
        """The full name of the topic."""
        return self._endpoint.token.name


class ServiceEntity(Announced):
    """Base of services and clients."""

    def __init__(self, endpoint: Endpoint, srv_type: Any, srv_name: str, callback: Any, group: CallbackGroup) -> None:
        self.srv_type, self.srv_name = srv_type, srv_name
        super().__init__(endpoint, callback, group)

    @property
    def service_name(self) -> str:
        """The full name of the service."""
        return self._endpoint.token.name
