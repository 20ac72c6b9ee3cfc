"""How a node answers what it is asked: an error never reaches the executor, and its reason reaches the operator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from octn_ros.errors import OctnError
from octn_ros.nodes import status
from octn_ros.nodes.diagnostics import NodeDiagnostics

Answer = TypeVar("Answer")


class Answers:
    """Counts requests in the node's diagnostics and reports refusals on its status topic and in its log.

    Safe from any thread.

    Args:
        diagnostics: of the node.
        topic: its status topic.
        standing: tells what holds in spite of a refusal, as named values.
    """

    def __init__(
        self,
        diagnostics: NodeDiagnostics,
        topic: status.StatusTopic,
        standing: Callable[[], dict[str, Any]] = dict,
    ) -> None:
        self._diagnostics, self._topic, self._standing = diagnostics, topic, standing

    def to(self, request: str, work: Callable[[], Answer]) -> tuple[Answer | None, str]:
        """Return what the work returns and no reason, or None and the reason why there is no answer.

        Args:
            request: name of the service or topic that asks.
            work: finds the answer; raises an OctnError where it refuses.
        """
        with self._diagnostics.request(request) as counted:
            try:
                return work(), ""
            except OctnError as error:
                reason, state = f"{request} refused: {error}", "refused"
            except Exception as error:  # a fault of ours, or memory that ran out: the node and its callers live on
                reason, state = f"{request} failed: {type(error).__name__}: {error}", "failed"
            counted.refused(reason)
            self._topic.report(status.ERROR, reason, {"state": state, **self._standing()})
            return None, reason
