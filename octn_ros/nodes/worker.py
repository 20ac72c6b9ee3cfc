"""A thread that does one long job at a time, away from the executor."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

Job = Callable[[Callable[[], bool]], None]


class _WorkerThread(threading.Thread):
    """Told apart from the threads of others."""


def any_working() -> bool:
    """Return whether the thread of any worker of this process lives, or one that `run_aside` began."""
    return any(isinstance(thread, _WorkerThread) for thread in threading.enumerate())


def run_aside(job: Callable[[], None], name: str) -> None:
    """Run a job once in a thread that nobody waits for, not even the end of the process."""
    _WorkerThread(target=job, name=name, daemon=True).start()


class Worker:
    """Runs jobs in a thread of its own; of those that wait, only the newest is kept.

    A job is given a function that says whether it was cancelled, and asks it often. It should not raise: whatever it
    raises is shown on stderr and ends this job only. All methods may be called from any thread.
    """

    def __init__(self, name: str) -> None:
        self._condition = threading.Condition()
        self._waiting: Job | None = None
        self._stop: threading.Event | None = None  # of the running job, None while idle
        self._closed = False
        self._thread = _WorkerThread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a job runs or waits."""
        with self._condition:
            return self._stop is not None or self._waiting is not None

    @property
    def closed(self) -> bool:
        """Whether `close` was called: what a job that still runs publishes with may be gone."""
        with self._condition:
            return self._closed

    def submit(self, job: Job, *, restart: bool = False) -> bool:
        """Run a job now, or after the present one in place of any that waits; return whether it has to wait.

        Args:
            job: what to run.
            restart: ask the running job to end, so that this one soon begins.
        """
        with self._condition:
            self._waiting = job
            if restart and self._stop is not None:
                self._stop.set()
            self._condition.notify()
            return self._stop is not None

    def cancel(self) -> int:
        """Ask the running job to end and forget the waiting one; return how many there were, 0 to 2."""
        with self._condition:
            jobs = (self._stop is not None) + (self._waiting is not None)
            self._waiting = None
            if self._stop is not None:
                self._stop.set()
            return jobs

    def close(self, timeout_s: float) -> None:
        """Cancel everything, take no more jobs, and wait at most `timeout_s` for the running one to end."""
        with self._condition:
            self._closed = True
            self.cancel()
            self._condition.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._condition:
                self._stop = None
                self._condition.wait_for(lambda: self._waiting is not None or self._closed)
                job, self._waiting = self._waiting, None
                if job is None or self._closed:
                    return
                stop = self._stop = threading.Event()
            try:
                job(stop.is_set)
            except Exception:  # shown as that of any thread, and the next job still finds a worker
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
