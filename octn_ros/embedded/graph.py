"""The graph of ROS entities, as the liveliness tokens of all processes tell it."""

from __future__ import annotations

import threading
from collections.abc import Callable

import zenoh

from octn_ros.embedded import wire
from octn_ros.embedded.wire import Token


def direct(callback: Callable[..., None]) -> zenoh.handlers.Callback:
    """Let Zenoh call `callback` in its own thread.

    Its default is a Python thread per callback, which is no daemon: a session left open would keep the process.
    """
    return zenoh.handlers.Callback(callback, indirect=False)


class Graph:
    """All entities in the domain that this session knows of, its own included. Safe to use from any thread."""

    def __init__(self, session: zenoh.Session, domain_id: int) -> None:
        self._tokens: dict[str, Token] = {}
        self._changed = threading.Condition()
        self._watch = session.liveliness().declare_subscriber(
            wire.tokens_of(domain_id), direct(self._on_token), history=True
        )

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                try:
                    self._tokens[key] = Token.parse(key)
                except ValueError:  # of another version of rmw_zenoh: not one we could talk to
                    return
            else:
                self._tokens.pop(key, None)
            self._changed.notify_all()

    def entities(self, kind: str, name: str | None = None) -> list[Token]:
        """Return the entities of one kind, with a full name if one is given (for nodes, the node's)."""
        with self._changed:
            found = [t for t in self._tokens.values() if t.kind == kind]
        return [t for t in found if name in (None, t.node if kind == wire.NODE else t.name)]

    def wait(self, predicate: Callable[[], bool], timeout_sec: float) -> bool:
        """Wait until `predicate`, tried again at each change, is true; return whether it is."""
        with self._changed:
            return self._changed.wait_for(predicate, timeout_sec)
