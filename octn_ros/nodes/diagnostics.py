"""What a node says about its health on `/diagnostics`: its state, and how its services are asked and answered."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from octn_ros.nodes import qos, status
from octn_ros.simulation import SIGN_OF_LIFE_S

TOPIC = "/diagnostics"  # absolute: aggregators listen there, whatever the node's namespace


class ServiceRequest:
    """One request of a service while it is answered; belongs to the thread that answers it."""

    def __init__(self) -> None:
        self.reason: str | None = None

    def refused(self, reason: str) -> None:
        """Say that the caller did not get what it asked for, and why; counted when the request ends."""
        self.reason = reason


class _Tally:
    """The requests of one service so far."""

    def __init__(self) -> None:
        self.answered = self.refused = self.running = 0
        self.last_s = self.total_s = self.longest_s = 0.0

    def end(self, seconds: float, refused: bool) -> None:
        self.running -= 1
        self.answered += 1
        self.refused += refused
        self.last_s, self.longest_s = seconds, max(self.longest_s, seconds)
        self.total_s += seconds

    def figures(self, service: str) -> dict[str, Any]:
        return {
            f"{service}.requests": self.answered,
            f"{service}.refused": self.refused,
            f"{service}.running": self.running,
            f"{service}.last_s": self.last_s,
            f"{service}.mean_s": self.total_s / self.answered if self.answered else 0.0,
            f"{service}.longest_s": self.longest_s,
        }


class NodeDiagnostics:
    """Publishes one status, named "/octn/planner: state" after its node, again and again; safe from any thread.

    Its timer runs in a callback group of its own, so a long service does not hold it up where the executor has a
    second thread.

    Args:
        node: the node that is described.
        describe: asked at each report for level, message and values, as `StatusTopic.report` takes them; it must not
            wait for anything. What it raises is reported in place of its answer.
        period_s: time between two reports, by a steady clock: they are signs of life, and simulated time may stand.
    """

    def __init__(
        self, node: Node, describe: Callable[[], tuple[bytes, str, dict[str, Any]]], *, period_s: float = SIGN_OF_LIFE_S
    ) -> None:
        self._node, self._describe = node, describe
        self._name = f"{node.get_fully_qualified_name()}: state"
        self._lock, self._reporting = threading.Lock(), threading.Lock()
        self._services: dict[str, _Tally] = {}
        self._errors, self._last_error, self._last_error_ns = 0, "", 0
        self._publisher = node.create_publisher(DiagnosticArray, TOPIC, qos.STREAM)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(period_s, self.report, callback_group=MutuallyExclusiveCallbackGroup(), clock=steady)

    @contextmanager
    def request(self, service: str) -> Iterator[ServiceRequest]:
        """Count a request of a service and its time, from here to the end of the block.

        A request that was `refused`, or whose block raises, counts as refused, and its reason is the node's last
        error. An exception passes on.
        """
        with self._lock:
            self._services.setdefault(service, _Tally()).running += 1
        request, began = ServiceRequest(), time.perf_counter()
        try:
            yield request
        except BaseException as error:
            request.refused(f"{type(error).__name__}: {error}")
            raise
        finally:
            with self._lock:
                self._services[service].end(time.perf_counter() - began, request.reason is not None)
            if request.reason is not None:
                self.failed(f"{service}: {request.reason}")

    def failed(self, reason: str) -> None:
        """Count an error that no request has to do with, and keep it as the last one."""
        now_ns = self._node.get_clock().now().nanoseconds
        with self._lock:
            self._errors += 1
            self._last_error, self._last_error_ns = reason, now_ns

    def age_s(self, stamp_ns: int) -> float:
        """Return how long ago a stamp was, by the node's clock: the age of a scan or of a field."""
        return (self._node.get_clock().now().nanoseconds - stamp_ns) * 1e-9

    def report(self) -> None:
        """Publish the state now, besides the reports that come by themselves."""
        if not self._node.context.ok():
            return  # the graph is gone
        with self._reporting:  # or an older state could be published after a newer one
            try:
                level, message, values = self._describe()
                report = status.to_report(self._node, self._name, level, message, {**values, **self._figures()})
            except Exception as error:  # a fault of ours must not end the reports, least of all silently
                message = f"the state cannot be told: {type(error).__name__}: {error}"
                report = status.to_report(self._node, self._name, status.ERROR, message, self._figures())
            self._publisher.publish(report)

    def _figures(self) -> dict[str, Any]:
        with self._lock:
            figures: dict[str, Any] = {"errors": self._errors}
            if self._errors:
                figures |= {"last_error": self._last_error, "last_error_age_s": self.age_s(self._last_error_ns)}
            for service, tally in sorted(self._services.items()):
                figures |= tally.figures(service)
        return figures
