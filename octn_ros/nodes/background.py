"""An executor that spins in a thread of its own and can be stopped from outside."""

from __future__ import annotations

import threading

from rclpy.executors import Executor, ExternalShutdownException
from rclpy.task import Future


class BackgroundSpin:
    """Spins an executor in a thread, from the start on until `stop`.

    `Executor.shutdown` is no way to stop a spinning executor of Jazzy: it takes away the guard condition that the
    callbacks in progress still use. A future that ends the spin leaves them alone.

    Args:
        executor: whose nodes are spun; it belongs to this thread until `stop` has returned.
        name: of the thread.
    """

    def __init__(self, executor: Executor, name: str) -> None:
        self._executor, self._end = executor, Future()
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def fault(self) -> BaseException | None:
        """What ended the spin before its time: an exception that a callback let through."""
        return self._fault

    def stop(self, timeout_s: float | None = None) -> None:
        """End the spin and wait for the thread."""
        self._end.set_result(None)
        self._executor.wake()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            self._executor.spin_until_future_complete(self._end)
        except ExternalShutdownException:
            pass
        except BaseException as error:  # there is nobody to raise it to; whoever waits asks for it
            self._fault = error
