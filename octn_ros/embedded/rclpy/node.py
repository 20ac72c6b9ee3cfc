"""Nodes."""

from __future__ import annotations

from collections.abc import Callable
from types import FrameType
from typing import Any, TypeVar

from rcl_interfaces.msg import Log, ParameterDescriptor, ParameterEvent

from octn_ros.embedded.absent import refuse_absent
from octn_ros.embedded.arguments import Arguments
from octn_ros.embedded.errors import refuse_arguments
from octn_ros.embedded.ready import Inbox, ReadyEntity
from octn_ros.embedded.transport import (
    ClientEndpoint,
    PublisherEndpoint,
    ServiceEndpoint,
    SubscriptionEndpoint,
    announce_node,
)
from octn_ros.embedded.wire import DEFAULT_DEPTH

from . import logging
from ._node_graph import NodeGraph
from ._node_parameters import NodeParameters
from .callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from .client import Client
from .clock import Clock, ROSClock
from .context import Context
from .duration import Duration
from .executors import Executor
from .guard_condition import GuardCondition
from .parameter import Parameter
from .parameter_service import ParameterService
from .publisher import Publisher
from .qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    qos_profile_parameter_events,
    qos_profile_services_default,
)
from .service import Service
from .subscription import Subscription
from .time import Time
from .time_source import TimeSource
from .timer import Timer
from .utilities import get_default_context

ROSOUT_QOS = QoSProfile(depth=1000, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10))
NANOSECONDS_PER_SECOND = 10**9
_Entity = TypeVar("_Entity", bound=ReadyEntity)


class Node(NodeGraph, NodeParameters):
    """What publishes, subscribes, serves and calls under one name; an executor runs its callbacks.

    Entities may be made and destroyed from any thread, though not one entity from two threads at once.

    Args:
        node_name: the name; a remap `__node` or `__ns` changes name or namespace.
        context: by default the default one.
        cli_args: ROS arguments for this node only, e.g. `["--ros-args", "-p", "rate:=2.0"]`; they come before the
            arguments of the context.
        namespace: put in front of names.
        use_global_arguments: whether the context's arguments count.
        enable_rosout: whether what the node logs is also published.
        start_parameter_services: whether other processes may read and set parameters.
        parameter_overrides: values for parameters that come before those in arguments.
        allow_undeclared_parameters: whether parameters may be set without being declared.
        automatically_declare_parameters_from_overrides: whether all values given in arguments become parameters.
        enable_logger_service: not supported.

    Raises:
        NotInitializedException: the context is not initialized, or is shut down.
        InvalidNodeNameException, InvalidNamespaceException: ROS does not allow the name.
        NotImplementedError: for `enable_logger_service`.
    """

    __getattr__ = refuse_absent("rclpy.node.Node")

    def __init__(
        self,
        node_name: str,
        *,
        context: Context | None = None,
        cli_args: list[str] | None = None,
        namespace: str | None = None,
        use_global_arguments: bool = True,
        enable_rosout: bool = True,
        start_parameter_services: bool = True,
        parameter_overrides: list[Parameter] | None = None,
        allow_undeclared_parameters: bool = False,
        automatically_declare_parameters_from_overrides: bool = False,
        enable_logger_service: bool = False,
    ) -> None:
        refuse_arguments("rclpy.node.Node", enable_logger_service=enable_logger_service)
        self._context = context or get_default_context()
        bus = self._context._open_bus()
        arguments = [Arguments(cli_args or []), *([self._context._arguments] if use_global_arguments else [])]
        NodeGraph.__init__(self, node_name, namespace, arguments, bus)
        overrides: dict[str, Any] = {}
        for given in reversed(arguments):  # the node's own come before the context's
            overrides.update(given.overrides(self.get_fully_qualified_name()))
        overrides.update({p.name: p.value for p in parameter_overrides or []})
        NodeParameters.__init__(self, overrides, allow_undeclared_parameters)
        self._executor: Executor | None = None
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._clients: list[Client] = []
        self._services: list[Service] = []
        self._timers: list[Timer] = []
        self._guards: list[GuardCondition] = []
        self._default_callback_group = MutuallyExclusiveCallbackGroup()
        self._clock = ROSClock()
        self._endpoint = announce_node(bus, self.get_fully_qualified_name())
        self._logger = logging.get_logger(self.get_fully_qualified_name()[1:].replace("/", "."))
        self._rosout = self.create_publisher(Log, "/rosout", ROSOUT_QOS) if enable_rosout else None
        if enable_rosout:
            logging._sinks[self._logger.name] = self._publish_log
        self._parameter_events = self.create_publisher(
            ParameterEvent, "/parameter_events", qos_profile_parameter_events
        )
        if automatically_declare_parameters_from_overrides:
            any_type = [(n, v, ParameterDescriptor(dynamic_typing=True)) for n, v in overrides.items()]
            self.declare_parameters("", any_type)
        self._time_source = TimeSource(self)
        if start_parameter_services:
            ParameterService(self)

    @property
    def context(self) -> Context:
        """The context the node was made in."""
        return self._context

    @property
    def default_callback_group(self) -> CallbackGroup:
        """The mutually exclusive group of all entities that are given none."""
        return self._default_callback_group

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

    def get_clock(self) -> Clock:
        """Return the node's clock, which follows `use_sim_time`."""
        return self._clock

    def get_logger(self) -> logging.RcutilsLogger:
        """Return the logger with the node's full name."""
        return self._logger

    def _entities(self) -> list[ReadyEntity]:
        return [*self._subscriptions, *self._clients, *self._services, *self._timers, *self._guards]

    def _publish_log(
        self, stamp_ns: int, severity: logging.LoggingSeverity, name: str, text: str, caller: FrameType
    ) -> None:
        if self._rosout is not None and self._context.ok():
            log = Log(stamp=Time(nanoseconds=stamp_ns).to_msg(), level=int(severity), name=name, msg=text)
            log.file, log.function, log.line = caller.f_code.co_filename, caller.f_code.co_name, caller.f_lineno
            self._rosout.publish(log)

    def _keep(self, entity: _Entity, held: list[_Entity]) -> _Entity:
        entity._inbox.node = self
        held.append(entity)
        if self._executor is not None:
            self._executor.wake()
        if entity._inbox:  # arrived before it could be told to the executor
            entity._inbox.notify()
        return entity

    def create_publisher(
        self,
        msg_type: Any,
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        publisher_class: type[Publisher] = Publisher,
    ) -> Publisher:
        """Return a new publisher of `publisher_class`.

        Raises:
            InvalidTopicNameException: ROS does not allow the name.
            TypeError, ValueError: `qos_profile` is neither a QoSProfile nor a depth.
            RuntimeError: `msg_type` is no message class of this runtime.
            NotImplementedError: for `event_callbacks` and `qos_overriding_options`.
        """
        refuse_arguments(
            "Node.create_publisher", event_callbacks=event_callbacks, qos_overriding_options=qos_overriding_options
        )
        qos = _profile(qos_profile)
        endpoint = PublisherEndpoint(self._endpoint, self.resolve_topic_name(topic), _type_name(msg_type), qos)
        group = callback_group or self._default_callback_group
        publisher = publisher_class(endpoint, msg_type, topic, qos, None, group)
        publisher._context = self._context
        self._publishers.append(publisher)
        return publisher

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        raw: bool = False,
    ) -> Subscription:
        """Return a new subscription.

        Args:
            msg_type: class of the messages.
            topic: its name, expanded and remapped.
            callback: called with each message, or its bytes if `raw`; a second argument gets a dict of times and
                numbers.
            qos_profile: a profile, or the depth of a default one.
            callback_group: by default the node's.
            event_callbacks: not supported.
            qos_overriding_options: not supported.
            raw: whether `callback` gets the bytes.

        Raises:
            The same as `create_publisher`; RuntimeError also for a callback with other than one or two arguments.
        """
        refuse_arguments(
            "Node.create_subscription", event_callbacks=event_callbacks, qos_overriding_options=qos_overriding_options
        )
        qos = _profile(qos_profile)
        keeps_all = qos.history == QoSHistoryPolicy.KEEP_ALL
        inbox = Inbox(self, None if keeps_all else qos.depth or DEFAULT_DEPTH)
        name = self.resolve_topic_name(topic)
        endpoint = SubscriptionEndpoint(self._endpoint, name, _type_name(msg_type), qos, inbox)
        group = callback_group or self._default_callback_group
        made = Subscription(endpoint, msg_type, topic, callback, group, qos, raw, None)
        return self._keep(made, self._subscriptions)

    def create_client(
        self,
        srv_type: Any,
        srv_name: str,
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Client:
        """Return a new client of a service; raise as `create_service`."""
        name = self.resolve_service_name(srv_name)
        endpoint = ClientEndpoint(self._endpoint, name, _type_name(srv_type), qos_profile, Inbox(self))
        group = callback_group or self._default_callback_group
        return self._keep(Client(self._context, endpoint, srv_type, srv_name, qos_profile, group), self._clients)

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Service:
        """Return a new service; `callback` gets request and an empty response and returns the response.

        Raises:
            InvalidServiceNameException: ROS does not allow the name.
            RuntimeError: `srv_type` is no service class of this runtime.
        """
        name = self.resolve_service_name(srv_name)
        endpoint = ServiceEndpoint(self._endpoint, name, _type_name(srv_type), qos_profile, Inbox(self))
        group = callback_group or self._default_callback_group
        return self._keep(Service(endpoint, srv_type, srv_name, callback, group, qos_profile), self._services)

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[[], Any],
        callback_group: CallbackGroup | None = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """Return a new timer with a period of the clock's time (by default the node's clock)."""
        period_ns = int(float(timer_period_sec) * NANOSECONDS_PER_SECOND)
        group = callback_group or self._default_callback_group
        made = Timer(callback, group, period_ns, clock or self._clock, context=self._context, autostart=autostart)
        return self._keep(made, self._timers)

    def create_guard_condition(
        self, callback: Callable[[], Any], callback_group: CallbackGroup | None = None
    ) -> GuardCondition:
        """Return a new guard condition."""
        group = callback_group or self._default_callback_group
        return self._keep(GuardCondition(callback, group, context=self._context), self._guards)

    def _destroy(self, entity: Any, held: list[Any]) -> bool:
        if entity not in held:
            return False
        held.remove(entity)
        entity.destroy()
        return True

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Destroy a publisher of this node; return whether it was one."""
        return self._destroy(publisher, self._publishers)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription of this node; return whether it was one."""
        return self._destroy(subscription, self._subscriptions)

    def destroy_client(self, client: Client) -> bool:
        """Destroy a client of this node; return whether it was one."""
        return self._destroy(client, self._clients)

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service of this node; return whether it was one."""
        return self._destroy(service, self._services)

    def destroy_timer(self, timer: Timer) -> bool:
        """Destroy a timer of this node; return whether it was one."""
        return self._destroy(timer, self._timers)

    def destroy_guard_condition(self, guard: GuardCondition) -> bool:
        """Destroy a guard condition of this node; return whether it was one."""
        return self._destroy(guard, self._guards)

    def destroy_node(self) -> None:
        """Destroy the node and all its entities; doing so twice, or after shutdown, is harmless."""
        if self._executor is not None:
            self._executor.remove_node(self)
        logging._sinks.pop(self._logger.name, None)
        self._rosout = None
        held: list[Any] = [*self._entities(), *self._publishers]
        for entities in (
            self._timers,
            self._services,
            self._clients,
            self._subscriptions,
            self._publishers,
            self._guards,
        ):
            entities.clear()
        for entity in held:
            entity.destroy()
        self._endpoint.close()


def _profile(qos: QoSProfile | int) -> QoSProfile:
    if isinstance(qos, QoSProfile):
        return qos
    if not isinstance(qos, int):
        raise TypeError(f"Expected QoSProfile or int, but received {type(qos)!r}")
    if qos < 0:
        raise ValueError(f"history depth must be greater than or equal to zero, got {qos}")
    return QoSProfile(depth=qos)


def _type_name(interface: Any) -> str:
    name = getattr(interface, "_ros_type", None)
    if not isinstance(name, str):
        raise RuntimeError(f"{interface!r} is no message or service class that the embedded runtime made")
    return name
