import atexit
import os
import sys
import threading
import weakref

from octn_ros.embedded import wire

from .arguments import Arguments
from .exceptions import NotInitializedException, RCLError


class Context:
    def __init__(self):
        self._ok, self._bus, self._executors, self._callbacks = False, None, weakref.WeakSet(), []
        self._lock, self.arguments = threading.RLock(), Arguments()

    def init(self, args=None, *, initialize_logging=True, domain_id=None):
        with self._lock:
            if self._ok:
                raise RuntimeError('Context.init() must only be called once')
            self.arguments = Arguments(sys.argv if args is None else args)
            self._domain_id = int(os.environ.get('ROS_DOMAIN_ID') or 0) if domain_id is None else domain_id
            if self._bus is not None:
                self._bus.close()
            self._bus, self._ok = wire.Bus(self._domain_id), True
            from . import logging
            for level in self.arguments.log_levels:
                name, _, value = level.rpartition(':=')
                logging.set_logger_level(name, value)
            atexit.register(self._close)

    @property
    def bus(self):
        if self._bus is None:
            raise NotInitializedException('context is not initialized')
        return self._bus

    def ok(self):
        return self._ok

    def get_domain_id(self):
        return self._domain_id

    def _stop(self):
        """What a signal does: no more callbacks, though entities live until destroyed."""
        self._ok = False
        for executor in list(self._executors):
            executor.wake()

    def shutdown(self):
        if not self._ok:
            raise RCLError('failed to shutdown: rcl_shutdown already called on the given context')
        self._stop()
        self._finish()

    def try_shutdown(self):
        self._stop()
        self._finish()

    def _finish(self):
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback()
        self._close()

    def _close(self):
        with self._lock:
            bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()
            atexit.unregister(self._close)

    def on_shutdown(self, callback):
        self._callbacks.append(callback)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.try_shutdown()


_default = Context()


def get_default_context(*, shutting_down=False):
    return _default
