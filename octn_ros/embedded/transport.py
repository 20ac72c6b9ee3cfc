"""What a node announces and sends through Zenoh: its publishers, subscriptions, services and clients."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from threading import Lock
from typing import Any

import zenoh
from zenoh import ext

from octn_ros.embedded import definitions, session, wire
from octn_ros.embedded.errors import InvalidHandle, RCLError
from octn_ros.embedded.graph import Graph, direct
from octn_ros.embedded.wire import Token

NO_TIMEOUT_MS = 10**8  # a request waits for its answer as long as its client lives
MISS_HEARTBEAT_SEC = 0.5


class Bus:
    """The Zenoh session of one context and the graph seen through it. Safe to use from any thread."""

    def __init__(self, domain_id: int) -> None:
        self.domain_id = domain_id
        self.session = session.open_session(domain_id)
        self.session_id = str(self.session.zid())
        self.entity_ids = itertools.count()
        self.graph = Graph(self.session, domain_id)
        self.ok = True  # until the context ends, be it by a signal

    def close(self) -> None:
        """Withdraw everything announced through this bus; doing so twice is harmless."""
        self.ok = False
        if not self.session.is_closed():
            self.session.close()


class Endpoint:
    """An announced entity: a node, or one of its publishers, subscriptions, services, clients.

    The token is declared last and withdrawn first, so whoever sees it also reaches what is behind it. May be used and
    closed from several threads.
    """

    def __init__(self, bus: Bus, node: Endpoint | None, token: Token, qos: Any = None, inbox: Any = None) -> None:
        self.bus, self.token, self.qos, self.inbox = bus, token, qos, inbox
        self.id = next(bus.entity_ids)
        self.node_id = self.id if node is None else node.id
        self.key = token.topic_key(bus.domain_id)
        self.token_key = token.key(bus.domain_id, bus.session_id, self.node_id, self.id)
        self.gid = wire.gid(self.token_key)
        self._sequence = itertools.count(1)
        self._lock = Lock()  # a Zenoh object that one thread withdraws must not be in use by another
        self._open = True
        self._declared = self._declare()
        self._liveliness = bus.session.liveliness().declare_token(self.token_key)

    def _declare(self) -> Any:
        """Declare what is behind the token and return it; nothing for nodes and clients."""
        return None

    def check_open(self) -> None:
        """Raise InvalidHandle if the entity was destroyed, RCLError if its context was shut down."""
        if not self._open:
            raise InvalidHandle("cannot use Destroyable because destruction was requested")
        if not self.bus.ok:
            raise RCLError(f"{self.token.name}: its context is shut down")

    def attachment(self) -> bytes:
        """Return the attachment of the next message."""
        return wire.pack_attachment(next(self._sequence), self.gid)

    def count(self, kind: str) -> int:
        """Return how many entities of a kind have this one's name."""
        return len(self.bus.graph.entities(kind, self.token.name))

    def close(self) -> None:
        """Withdraw the entity; doing so twice, or after the bus was closed, is harmless.

        Waits for a message that another thread is just sending.
        """
        with self._lock:
            if self._open and not self.bus.session.is_closed():
                self._liveliness.undeclare()
                if self._declared is not None:
                    self._declared.undeclare()
            self._open = False


def announce_node(bus: Bus, path: str) -> Endpoint:
    """Announce the node with the fully qualified name `path`."""
    return Endpoint(bus, None, Token(wire.NODE, path))


class _TopicEndpoint(Endpoint):
    kind: str

    def __init__(self, node: Endpoint, name: str, ros_type: str, qos: Any, inbox: Any = None) -> None:
        self.reliable = qos.reliability != wire.BEST_EFFORT
        self.latched = qos.durability == wire.TRANSIENT_LOCAL
        types = definitions.dds_name(ros_type), definitions.type_hash(ros_type)
        token = Token(self.kind, node.token.node, name, *types, wire.qos_text(qos))
        super().__init__(node.bus, node, token, qos, inbox)


class PublisherEndpoint(_TopicEndpoint):
    """Sends to a topic; if latched, keeps the last `depth` messages for those who join late."""

    kind = wire.PUBLISHER

    def _declare(self) -> Any:
        control = zenoh.CongestionControl
        # As rmw_zenoh: only keep-all waits for slow readers, else one stuck reader would stop its writers.
        blocks = self.reliable and self.qos.history == wire.KEEP_ALL
        options: dict[str, Any] = {
            "congestion_control": control.BLOCK if blocks else control.DROP,
            "reliability": zenoh.Reliability.RELIABLE if self.reliable else zenoh.Reliability.BEST_EFFORT,
        }
        if not self.latched:
            return self.bus.session.declare_publisher(self.key, **options)
        detection = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=MISS_HEARTBEAT_SEC)
        return ext.declare_advanced_publisher(
            self.bus.session,
            self.key,
            **options,
            publisher_detection=True,
            cache=ext.CacheConfig(self.qos.depth or wire.DEFAULT_DEPTH),
            sample_miss_detection=detection if self.reliable else None,
        )

    def put(self, data: bytes) -> None:
        """Send `data`; numbers go out in order also when several threads send.

        Raises:
            InvalidHandle: the publisher was destroyed.
            RCLError: its context was shut down, be it while the message was on its way.
        """
        with self._lock:
            self.check_open()
            try:
                self._declared.put(data, attachment=self.attachment())
            except zenoh.ZError:
                self.check_open()
                raise


class SubscriptionEndpoint(_TopicEndpoint):
    """Puts what arrives on a topic into its inbox, first what latched publishers sent before."""

    kind = wire.SUBSCRIPTION

    def _declare(self) -> Any:
        if not self.latched:
            return self.bus.session.declare_subscriber(self.key, direct(self.inbox.put))
        depth = self.qos.depth or wire.DEFAULT_DEPTH
        recovery = ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        return ext.declare_advanced_subscriber(
            self.bus.session,
            self.key,
            direct(self.inbox.put),
            subscriber_detection=True,
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=depth),
            recovery=recovery if self.reliable else None,
        )


class ServiceEndpoint(_TopicEndpoint):
    """Puts requests into its inbox as Zenoh queries."""

    kind = wire.SERVICE

    def _declare(self) -> Any:
        return self.bus.session.declare_queryable(self.key, direct(self.inbox.put), complete=True)

    def reply(self, query: Any, data: bytes) -> None:
        """Answer a request from the inbox."""
        sequence, _, sender = wire.unpack_attachment(query.attachment.to_bytes())
        query.reply(self.key, data, attachment=wire.pack_attachment(sequence, sender))
        query.drop()


class ClientEndpoint(_TopicEndpoint):
    """Sends requests to a service."""

    kind = wire.CLIENT

    def request(self, data: bytes, on_reply: Callable[[bytes], None]) -> int:
        """Send a request and return its number; `on_reply` gets the answer in a thread of Zenoh's, if one comes."""
        self.check_open()
        sequence = next(self._sequence)

        def arrived(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                on_reply(reply.ok.payload.to_bytes())

        self.bus.session.get(
            self.key,
            direct(arrived),
            payload=data,
            attachment=wire.pack_attachment(sequence, self.gid),
            timeout=NO_TIMEOUT_MS,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return sequence
