"""The context: one session, shared by the nodes made in it."""

from __future__ import annotations

import atexit
import os
import sys
import threading
import weakref
from typing import TYPE_CHECKING

from octn_ros.embedded.absent import refuse_absent
from octn_ros.embedded.arguments import Arguments
from octn_ros.embedded.errors import RCLError
from octn_ros.embedded.transport import Bus

from . import logging
from .exceptions import NotInitializedException

if TYPE_CHECKING:
    from .executors import Executor

__getattr__ = refuse_absent("rclpy.context")


class Context:
    """Initialized once and shut down once. All methods may be called from any thread."""

    __getattr__ = refuse_absent("rclpy.context.Context")

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._bus: Bus | None = None
        self._arguments = Arguments()
        self._executors: weakref.WeakSet[Executor] = weakref.WeakSet()

    def init(
        self, args: list[str] | None = None, *, initialize_logging: bool = True, domain_id: int | None = None
    ) -> None:
        """Read the arguments (None: `sys.argv`) and open the session.

        Raises:
            RuntimeError: the context was initialized before.
            RCLError: the arguments cannot be parsed.
        """
        with self._lock:
            if self._bus is not None:
                raise RuntimeError("Context.init() must only be called once")
            self._arguments = Arguments(sys.argv if args is None else args)
            if initialize_logging:
                for level in self._arguments.log_levels:
                    name, _, severity = level.rpartition(":=")
                    logging.set_logger_level(name, logging.get_logging_severity_from_string(severity))
            self._bus = Bus(int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain_id is None else domain_id)
            _running.add(self)
            atexit.register(self._bus.close)

    def _open_bus(self) -> Bus:
        if self._bus is None or not self._bus.ok:
            raise NotInitializedException("the context is not initialized, or is shut down")
        return self._bus

    def ok(self) -> bool:
        """Return whether the context is initialized and neither shut down nor ended by a signal."""
        return self._bus is not None and self._bus.ok

    def _stop(self) -> None:
        """Let executors end; all that a signal handler may do, as it sets flags and wakes queues only."""
        if self._bus is not None:
            self._bus.ok = False
        for executor in list(self._executors):
            executor.wake()

    def shutdown(self) -> None:
        """End the context and close its session; raise RuntimeError if it is not running."""
        if not self.ok():
            raise RCLError("failed to shutdown: the context is not initialized, or is shut down already")
        self.try_shutdown()

    def try_shutdown(self) -> None:
        """End the context, if it is running, and close its session."""
        with self._lock:
            self._stop()
            if self._bus is not None:
                self._bus.close()
                atexit.unregister(self._bus.close)


_running: weakref.WeakSet[Context] = weakref.WeakSet()


def _stop_all() -> None:
    """Let all contexts end; may be called in a signal handler."""
    for context in list(_running):
        context._stop()
