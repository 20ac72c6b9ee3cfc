"""Work that a node does beside its executor, where only the newest request counts."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from octn_ros.errors import in_words
from octn_ros.nodes.worker import Worker

CLOSE_S = 5.0


class _SupersededError(Exception):
    """Newer work waits; what this one has done so far is dropped."""


class LatestWork:
    """Runs work in a thread of its own: one piece at a time, and of those that wait only the newest.

    A piece that runs while a newer one comes ends at its next look. What a piece raises is reported and ends it alone.
    All methods may be called from any thread.

    Args:
        node: the node whose work it is; nothing is reported once its context is gone.
        name: of the thread.
        failed: told why a piece of work failed, in words.
    """

    def __init__(self, node: Node, name: str, failed: Callable[[str], None]) -> None:
        self._node, self._failed = node, failed
        self._worker = Worker(name)

    @property
    def busy(self) -> bool:
        """Whether a piece of work runs or waits."""
        return self._worker.busy

    def ask(self, work: Callable[[Callable[[], None]], None]) -> None:
        """Do this next, in place of whatever waits.

        Args:
            work: given a function to call now and then; it raises where newer work waits.
        """

        def job(cancelled: Callable[[], bool]) -> None:
            def look() -> None:
                if cancelled() or not self._node.context.ok():
                    raise _SupersededError

            try:
                look()
                work(look)
            except _SupersededError:
                pass
            except Exception as error:  # a fault of ours, or memory that ran out: the node lives on
                if self._node.context.ok() and not self._worker.closed:  # else nothing could be published any more
                    self._failed(in_words(error))

        self._worker.submit(job, restart=True)

    def close(self) -> None:
        """Take no more work and wait a little for the running piece to end."""
        self._worker.close(CLOSE_S)
