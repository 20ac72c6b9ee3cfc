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
        self._ok = False
        self._domain_id = 0
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
            self._domain_id = int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain_id is None else domain_id
            if initialize_logging:
                for level in self._arguments.log_levels:
                    name, _, severity = level.rpartition(":=")
                    logging.set_logger_level(name, logging.get_logging_severity_from_string(severity))
            self._bus = Bus(self._domain_id)
            self._ok = True
            _running.add(self)
            atexit.register(self._bus.close)

    def _open_bus(self) -> Bus:
        if self._bus is None or not self._ok:
            raise NotInitializedException("cannot create node: the context is not initialized, or is shut down")
        return self._bus

    def ok(self) -> bool:
        """Return whether the context is initialized and neither shut down nor ended by a signal."""
        return self._ok

    def get_domain_id(self) -> int:
        """Return the domain id; raise NotInitializedException before `init`."""
        if self._bus is None:
            raise NotInitializedException
        return self._domain_id

    def _stop(self) -> None:
        """Let executors end; all that a signal handler may do, as it sets flags and wakes queues only."""
        self._ok = False
        for executor in list(self._executors):
            executor.wake()

    def shutdown(self) -> None:
        """End the context and close its session; raise RuntimeError if it is not running."""
        if self._bus is None:
            raise RuntimeError("Context must be initialized before it can be shutdown")
        if not self._ok:
            raise RCLError("failed to shutdown: rcl_shutdown already called on the given context")
        self.try_shutdown()

    def try_shutdown(self) -> None:
        """End the context, if it is running, and close its session."""
        with self._lock:
            self._stop()
            bus = self._bus
        if bus is not None and not bus.closed:
            bus.close()
            atexit.unregister(bus.close)


_running: weakref.WeakSet[Context] = weakref.WeakSet()


def _stop_all() -> None:
    """Let all contexts end; may be called in a signal handler."""
    for context in list(_running):
        context._stop()
