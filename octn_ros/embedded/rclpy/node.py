"""Nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from rcl_interfaces.msg import ParameterEvent
from rosgraph_msgs.msg import Clock as ClockMessage

from octn_ros.embedded import transport
from octn_ros.embedded.absent import refuse_absent, refuse_arguments
from octn_ros.embedded.arguments import Arguments
from octn_ros.embedded.ready import Inbox, ReadyEntity
from octn_ros.embedded.wire import DEFAULT_DEPTH

from . import logging
from ._node_graph import NodeGraph
from ._node_parameters import NodeParameters
from .callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from .client import Client
from .clock import Clock, ROSClock
from .context import Context
from .executors import Executor
from .parameter import Parameter
from .parameter_service import ParameterService
from .publisher import Publisher
from .qos import (
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_parameter_events,
    qos_profile_services_default,
)
from .service import Service
from .subscription import Subscription
from .time import Time
from .timer import Timer
from .utilities import get_default_context

NANOSECONDS_PER_SECOND = 10**9
USE_SIM_TIME = "use_sim_time"
SERVICE_QOS = qos_profile_services_default
CLOCK_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_Entity = TypeVar("_Entity", bound=ReadyEntity)
_Group = CallbackGroup | None
_Callback = Callable[..., Any]


class Node(NodeGraph, NodeParameters):
    """What publishes, subscribes, serves and calls under one name; an executor runs its callbacks.

    Entities may be made and destroyed from any thread, though not one entity from two threads at once. What the node
    logs goes to stderr only, not to /rosout.

    Args:
        node_name: the name; a remap `__node` or `__ns` changes name or namespace.
        context: by default the default one.
        namespace: put in front of names.
        use_global_arguments: whether the context's arguments count.
        start_parameter_services: whether other processes may read and set parameters.
        parameter_overrides: values for parameters that come before those in arguments.
        lacking: arguments that are not supported.

    Raises:
        NotInitializedException: the context is not initialized, or is shut down.
        InvalidNodeNameException, InvalidNamespaceException: ROS does not allow the name.
        NotImplementedError: for an argument of rclpy that is not supported.
    """

    __getattr__ = refuse_absent("rclpy.node.Node")

    def __init__(
        self,
        node_name: str,
        *,
        context: Context | None = None,
        namespace: str | None = None,
        use_global_arguments: bool = True,
        start_parameter_services: bool = True,
        parameter_overrides: list[Parameter] | None = None,
        **lacking: Any,
    ) -> None:
        refuse_arguments("rclpy.node.Node()", lacking)
        self.context = context or get_default_context()
        bus = self.context._open_bus()
        arguments = self.context._arguments if use_global_arguments else Arguments()
        NodeGraph.__init__(self, node_name, namespace, arguments, bus)
        given = {p.name: p.value for p in parameter_overrides or []}
        NodeParameters.__init__(self, {**arguments.overrides(self.get_fully_qualified_name()), **given})
        self._executor: Executor | None = None
        self._entities: list[ReadyEntity] = []
        self._timers: list[Timer] = []
        self.default_callback_group: CallbackGroup = MutuallyExclusiveCallbackGroup()
        self._clock = ROSClock()
        self._clock_subscription: Subscription | None = None
        self._endpoint = transport.announce_node(bus, self.get_fully_qualified_name())
        self._logger = logging.get_logger(self.get_fully_qualified_name()[1:].replace("/", "."))
        self._parameter_events = self.create_publisher(
            ParameterEvent, "/parameter_events", qos_profile_parameter_events
        )
        self.declare_parameter(USE_SIM_TIME, False)
        if start_parameter_services:
            ParameterService(self)

    @property
    def executor(self) -> Executor | None:
        """The executor that runs the node's callbacks; setting it moves the node."""
        return self._executor

    @executor.setter
    def executor(self, new_executor: Executor | None) -> None:
        old, self._executor = self._executor, new_executor
        if old is not None and old is not new_executor:
            old.remove_node(self)
        if new_executor is not None:
            new_executor.add_node(self)

    @property
    def publishers(self) -> Iterator[Publisher]:
        """The node's publishers, that of /parameter_events among them."""
        return (entity for entity in list(self._entities) if isinstance(entity, Publisher))

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The node's subscriptions."""
        return (entity for entity in list(self._entities) if isinstance(entity, Subscription))

    @property
    def services(self) -> Iterator[Service]:
        """The node's services, those of its parameters among them."""
        return (entity for entity in list(self._entities) if isinstance(entity, Service))

    def get_clock(self) -> Clock:
        """Return the node's clock, which follows `use_sim_time`."""
        return self._clock

    def get_logger(self) -> logging.RcutilsLogger:
        """Return the logger with the node's full name."""
        return self._logger

    def _were_set(self, parameters: list[Parameter]) -> None:
        """Follow /clock while `use_sim_time` is true; before its first message the time is 0."""
        for wanted in [p.value for p in parameters if p.name == USE_SIM_TIME]:
            if wanted and self._clock_subscription is None:
                self._clock._simulated = 0
                self._clock_subscription = self.create_subscription(
                    ClockMessage, "/clock", self._move_clock, CLOCK_QOS, callback_group=ReentrantCallbackGroup()
                )
            elif not wanted and self._clock_subscription is not None:
                self.destroy_subscription(self._clock_subscription)
                self._clock_subscription = self._clock._simulated = None

    def _move_clock(self, message: Any) -> None:
        if self._clock_subscription is not None:
            self._clock._simulated = Time.from_msg(message.clock).nanoseconds

    def _keep(self, entity: _Entity) -> _Entity:
        self._entities.append(entity)
        if self._executor is not None:
            self._executor.wake()
        return entity

    def create_publisher(
        self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, *, callback_group: _Group = None, **lacking: Any
    ) -> Publisher:
        """Return a new publisher.

        Raises:
            InvalidTopicNameException: ROS does not allow the name.
            TypeError, ValueError: `qos_profile` is neither a QoSProfile nor a depth.
            RuntimeError: `msg_type` is no message class of this runtime.
            NotImplementedError: for an argument of rclpy that is not supported.
        """
        refuse_arguments("Node.create_publisher", lacking)
        name, qos = self.resolve_topic_name(topic), _profile(qos_profile)
        endpoint = transport.PublisherEndpoint(self._endpoint, name, _type_name(msg_type), qos, Inbox(self))
        return self._keep(Publisher(endpoint, msg_type, topic, None, callback_group or self.default_callback_group))

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: _Callback,
        qos_profile: QoSProfile | int,
        *,
        callback_group: _Group = None,
        raw: bool = False,
        **lacking: Any,
    ) -> Subscription:
        """Return a new subscription.

        Args:
            msg_type: class of the messages.
            topic: its name, expanded and remapped.
            callback: called with each message.
            qos_profile: a profile, or the depth of a default one.
            callback_group: by default the node's.
            raw: the callback gets the encoded bytes of each message in place of the message.
            lacking: arguments that are not supported.

        Raises:
            The same as `create_publisher`; NotImplementedError also for a callback that takes more than a message.
        """
        refuse_arguments("Node.create_subscription", lacking)
        name, qos = self.resolve_topic_name(topic), _profile(qos_profile)
        inbox = Inbox(self, _depth(qos))
        endpoint = transport.SubscriptionEndpoint(self._endpoint, name, _type_name(msg_type), qos, inbox)
        group = callback_group or self.default_callback_group
        return self._keep(Subscription(endpoint, msg_type, topic, callback, group, raw))

    def create_client(
        self, srv_type: Any, srv_name: str, *, qos_profile: QoSProfile = SERVICE_QOS, callback_group: _Group = None
    ) -> Client:
        """Return a new client of a service; raise as `create_service`."""
        name, inbox = self.resolve_service_name(srv_name), Inbox(self)
        endpoint = transport.ClientEndpoint(self._endpoint, name, _type_name(srv_type), qos_profile, inbox)
        return self._keep(Client(endpoint, srv_type, srv_name, None, callback_group or self.default_callback_group))

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: _Callback,
        *,
        qos_profile: QoSProfile = SERVICE_QOS,
        callback_group: _Group = None,
    ) -> Service:
        """Return a new service; `callback` gets request and an empty response and returns the response.

        Of requests that wait, as many are kept as the profile's depth says, 10 by default; as with rmw_zenoh the oldest
        gives way to a new one, and its client gets no answer.

        Raises:
            InvalidServiceNameException: ROS does not allow the name.
            RuntimeError: `srv_type` is no service class of this runtime.
        """
        name = self.resolve_service_name(srv_name)
        inbox = Inbox(self, _depth(qos_profile))
        endpoint = transport.ServiceEndpoint(self._endpoint, name, _type_name(srv_type), qos_profile, inbox)
        group = callback_group or self.default_callback_group
        return self._keep(Service(endpoint, srv_type, srv_name, callback, group))

    def create_timer(
        self,
        timer_period_sec: float,
        callback: _Callback,
        callback_group: _Group = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """Return a new timer with a period of the clock's time (by default the node's clock)."""
        period_ns = int(float(timer_period_sec) * NANOSECONDS_PER_SECOND)
        group = callback_group or self.default_callback_group
        timer = Timer(self, callback, group, period_ns, clock or self._clock, autostart)
        self._timers.append(timer)
        return self._keep(timer)

    def _destroy(self, entity: ReadyEntity) -> bool:
        if entity not in self._entities:
            return False
        self._entities.remove(entity)
        self._timers = [t for t in self._timers if t is not entity]
        entity.destroy()
        return True

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Destroy a publisher of this node; return whether it was one."""
        return self._destroy(publisher)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription of this node; return whether it was one."""
        return self._destroy(subscription)

    def destroy_client(self, client: Client) -> bool:
        """Destroy a client of this node; return whether it was one."""
        return self._destroy(client)

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service of this node; return whether it was one."""
        return self._destroy(service)

    def destroy_timer(self, timer: Timer) -> bool:
        """Destroy a timer of this node; return whether it was one."""
        return self._destroy(timer)

    def destroy_node(self) -> None:
        """Destroy the node and all its entities; doing so twice, or after shutdown, is harmless."""
        if self._executor is not None:
            self._executor.remove_node(self)
        for entity in self._entities[::-1]:
            self._destroy(entity)
        self._endpoint.close()


def _profile(qos: QoSProfile | int) -> QoSProfile:
    if isinstance(qos, QoSProfile):
        return qos
    if not isinstance(qos, int):
        raise TypeError(f"Expected QoSProfile or int, but received {type(qos)!r}")
    return QoSProfile(depth=qos)


def _depth(qos: QoSProfile) -> int | None:
    """Return how many messages or requests a profile keeps, None for all."""
    return None if qos.history == HistoryPolicy.KEEP_ALL else qos.depth or DEFAULT_DEPTH


def _type_name(interface: Any) -> str:
    name = getattr(interface, "_ros_type", None)
    if not isinstance(name, str):
        raise RuntimeError(f"{interface!r} is no message or service class that the embedded runtime made")
    return name
