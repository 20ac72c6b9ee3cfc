"""What an executor runs: entities with an inbox, which stand in the executor's queue while something is in it."""

from __future__ import annotations

from collections import deque
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from octn_ros.embedded.rclpy.callback_groups import CallbackGroup
    from octn_ros.embedded.rclpy.executors import Executor
    from octn_ros.embedded.rclpy.node import Node

Work = Callable[[], Awaitable[Any]]


class Inbox:
    """Bounded queue of what arrived for one entity; when it is full, the oldest item goes.

    `put` may be called from any thread and also from a signal handler. It takes no lock: Zenoh calls it in the thread
    that publishes, where that is in the same process.
    """

    def __init__(self, node: Node | None = None, depth: int | None = None) -> None:
        self.node = node
        self.entity: ReadyEntity | None = None
        self.posted: Executor | None = None  # the executor in whose queue the entity stands
        self._items: deque[Any] = deque(maxlen=depth)

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Any) -> None:
        """Add an item and tell the node's executor."""
        self._items.append(item)
        self.notify()

    def notify(self) -> None:
        """Let the entity stand in its executor's queue, once."""
        executor = None if self.node is None else self.node.executor
        if executor is not None and self.entity is not None and self.posted is not executor:
            self.posted = executor
            executor._post(self.entity)

    def pop(self) -> Any:
        """Return the oldest item, or None."""
        try:
            return self._items.popleft()
        except IndexError:
            return None


class ReadyEntity:
    """Base of subscriptions, services, clients, timers and guard conditions."""

    def __init__(self, callback: Any, callback_group: CallbackGroup, inbox: Inbox | None = None) -> None:
        self.callback = callback
        self.callback_group = callback_group
        self._inbox = Inbox() if inbox is None else inbox
        callback_group.add_entity(self)
        self._inbox.entity = self
        if self._inbox:  # arrived between the declaration and here
            self._inbox.notify()

    def _take(self) -> Work | None:
        """Return what to run now, or None. Called by the executor while it holds the callback group."""
        raise NotImplementedError
