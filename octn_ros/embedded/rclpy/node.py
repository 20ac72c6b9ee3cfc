import re
import warnings
from math import isclose

from rcl_interfaces.msg import (Log, ListParametersResult, ParameterDescriptor, ParameterEvent, ParameterType,
                                ParameterValue, SetParametersResult)
from rcl_interfaces.srv import (DescribeParameters, GetParameters, GetParameterTypes, ListParameters,
                                SetParameters, SetParametersAtomically)
from octn_ros.embedded import wire

from . import logging
from .arguments import Arguments
from .callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from .clock import ROSClock
from .context import get_default_context
from .duration import Duration
from .entities import Client, GuardCondition, Publisher, Rate, Service, Subscription, Timer
from .exceptions import (InvalidNodeNameException, InvalidParameterTypeException, InvalidParameterValueException,
                         InvalidTopicNameException, NotInitializedException, ParameterAlreadyDeclaredException,
                         ParameterImmutableException, ParameterNotDeclaredException, ParameterUninitializedException)
from .parameter import Parameter, parameter_value_to_python
from .qos import QoSProfile, qos_profile_parameter_events, qos_profile_parameters, qos_profile_services_default
from .time import Time

_TOPIC = re.compile(r'(~|/|~/)?([A-Za-z_]\w*)?(/[A-Za-z_]\w*)*')
_ROSOUT = QoSProfile(depth=1000, durability=1, lifespan=Duration(seconds=10))
_NOT_SET = Parameter.Type.NOT_SET


def _ok(successful=True, reason=''):
    return SetParametersResult(successful=successful, reason=reason)


class Node:
    def __init__(self, node_name, *, context=None, cli_args=None, namespace=None, use_global_arguments=True,
                 enable_rosout=True, start_parameter_services=True, parameter_overrides=None,
                 allow_undeclared_parameters=False, automatically_declare_parameters_from_overrides=False,
                 enable_logger_service=False):
        self._context = context or get_default_context()
        if not self._context.ok():
            raise NotInitializedException('cannot create node')
        local = Arguments(['--ros-args', *cli_args] if cli_args and '--ros-args' not in cli_args else cli_args or [])
        self._arguments = [local] + ([self._context.arguments] if use_global_arguments else [])
        for args in reversed(self._arguments):
            namespace = args.name_of('__ns', node_name, namespace or '/')
        self._name = node_name
        for args in reversed(self._arguments):
            self._name = args.name_of('__node', node_name, self._name)
        if not re.fullmatch(r'[A-Za-z_]\w*', self._name):
            raise InvalidNodeNameException(self._name, 'must be alphanumerics or underscores', 0)
        self._namespace = '/' + namespace.strip('/')
        self._bus = self._context.bus
        self._entity = wire.Entity(self._bus, None, 'NN', self.get_fully_qualified_name())
        self._entity.announce()
        self._logger = logging.get_logger(self.get_fully_qualified_name()[1:].replace('/', '.'))
        self._executor, self._destroyed = None, False
        self._default_callback_group = MutuallyExclusiveCallbackGroup()
        self._publishers, self._subscriptions, self._clients = [], [], []
        self._services, self._timers, self._guards = [], [], []
        self._parameters, self._descriptors, self._overrides = {}, {}, {}
        self._pre_set, self._on_set, self._post_set = [], [], []
        self._allow_undeclared_parameters = allow_undeclared_parameters
        for args in reversed(self._arguments):
            self._overrides.update(args.overrides(self.get_fully_qualified_name()))
        self._overrides.update({p.name: p.value for p in parameter_overrides or ()})
        self._clock = ROSClock()
        self._parameter_events = self.create_publisher(ParameterEvent, '/parameter_events', qos_profile_parameter_events)
        if enable_rosout:
            self._rosout = self.create_publisher(Log, '/rosout', _ROSOUT)
            logging.sinks[self._logger.name.split('.')[0]] = self._log
        if automatically_declare_parameters_from_overrides:
            self.declare_parameters('', [(n, v, ParameterDescriptor(dynamic_typing=True)) for n, v in self._overrides.items()])
        self._clock_subscription = None
        if not self.has_parameter('use_sim_time'):
            self.declare_parameter('use_sim_time', False)
        self.add_post_set_parameters_callback(self._follow_clock)
        self._follow_clock([self._parameters['use_sim_time']])
        if start_parameter_services:
            self._start_parameter_services()

    # --- identity

    context = property(lambda self: self._context)
    default_callback_group = property(lambda self: self._default_callback_group)
    publishers = property(lambda self: iter(self._publishers))
    subscriptions = property(lambda self: iter(self._subscriptions))
    clients = property(lambda self: iter(self._clients))
    services = property(lambda self: iter(self._services))
    timers = property(lambda self: iter(self._timers))
    guards = property(lambda self: iter(self._guards))

    def get_name(self):
        return self._name

    def get_namespace(self):
        return self._namespace

    def get_fully_qualified_name(self):
        return f'{self._namespace.rstrip("/")}/{self._name}'

    def get_logger(self):
        return self._logger

    def get_clock(self):
        return self._clock

    @property
    def executor(self):
        return self._executor

    @executor.setter
    def executor(self, new):
        old, self._executor = self._executor, new
        if old is not None and old is not new:
            old.remove_node(self)
        if new is not None:
            new.add_node(self)

    def _entities(self):
        return [*self._subscriptions, *self._clients, *self._services, *self._timers, *self._guards]

    def _log(self, stamp_ns, severity, name, text, frame):
        if not self._destroyed and self._context.ok():
            self._rosout.publish(Log(stamp=Time(nanoseconds=stamp_ns).to_msg(), level=int(severity), name=name, msg=text,
                                     file=frame.f_code.co_filename, function=frame.f_code.co_name, line=frame.f_lineno))

    def resolve_topic_name(self, topic, *, only_expand=False):
        name = topic.replace('{node}', self._name).replace('{ns}', self._namespace).replace('{namespace}', self._namespace)
        if not topic or not _TOPIC.fullmatch(name) or name.endswith('/'):
            raise InvalidTopicNameException(topic, 'topic name is not valid', 0)
        full = self._expand(name)
        if not only_expand:
            for args in self._arguments:
                for node, left, right in args.remaps:
                    if node in ('', self._name) and not left.startswith('__') and self._expand(
                            re.sub('^(rostopic|rosservice)://', '', left)) == full:
                        return self._expand(right)
        return full

    resolve_service_name = resolve_topic_name

    def _expand(self, name):
        base = self._namespace.rstrip('/')
        if name.startswith('~'):
            return f'{base}/{self._name}{"/" * (len(name) > 1 and name[1] != "/")}{name[1:]}'
        return name if name.startswith('/') else f'{base}/{name}'

    # --- entities

    def _keep(self, entity, held):
        held.append(entity)
        if self._executor is not None:
            self._executor.wake()
        return entity

    def _check(self, kind):
        if not hasattr(kind, '_ROS_TYPE'):
            raise RuntimeError(f'{kind!r} is not a ROS interface type')

    def create_publisher(self, msg_type, topic, qos_profile, *, callback_group=None, event_callbacks=None,
                         qos_overriding_options=None, publisher_class=Publisher):
        self._check(msg_type)
        return self._keep(publisher_class(self, msg_type, self.resolve_topic_name(topic), _qos(qos_profile)), self._publishers)

    def create_subscription(self, msg_type, topic, callback, qos_profile, *, callback_group=None,
                            event_callbacks=None, qos_overriding_options=None, raw=False):
        self._check(msg_type)
        return self._keep(Subscription(self, msg_type, self.resolve_topic_name(topic), callback, _qos(qos_profile),
                                       callback_group, raw), self._subscriptions)

    def create_client(self, srv_type, srv_name, *, qos_profile=qos_profile_services_default, callback_group=None):
        self._check(srv_type)
        return self._keep(Client(self, srv_type, self.resolve_topic_name(srv_name), qos_profile, callback_group), self._clients)

    def create_service(self, srv_type, srv_name, callback, *, qos_profile=qos_profile_services_default, callback_group=None):
        self._check(srv_type)
        return self._keep(Service(self, srv_type, self.resolve_topic_name(srv_name), callback, qos_profile,
                                  callback_group), self._services)

    def create_timer(self, timer_period_sec, callback, callback_group=None, clock=None, autostart=True):
        return self._keep(Timer(self, callback, callback_group, int(float(timer_period_sec) * 1e9),
                                clock or self._clock, autostart), self._timers)

    def create_guard_condition(self, callback, callback_group=None):
        return self._keep(GuardCondition(self, callback, callback_group), self._guards)

    def create_rate(self, frequency, clock=None):
        return Rate(self, frequency, clock or self._clock)

    def _destroy(self, entity, held):
        if entity not in held:
            return False
        held.remove(entity)
        entity.destroy()
        return True

    def destroy_publisher(self, entity):
        return self._destroy(entity, self._publishers)

    def destroy_subscription(self, entity):
        return self._destroy(entity, self._subscriptions)

    def destroy_client(self, entity):
        return self._destroy(entity, self._clients)

    def destroy_service(self, entity):
        return self._destroy(entity, self._services)

    def destroy_timer(self, entity):
        return self._destroy(entity, self._timers)

    def destroy_guard_condition(self, entity):
        return self._destroy(entity, self._guards)

    def destroy_node(self):
        if self._destroyed:
            return
        self._destroyed = True
        if self._executor is not None:
            self._executor.remove_node(self)
        logging.sinks.pop(self._logger.name.split('.')[0], None)
        if self._context._bus is self._bus:  # else the session took everything along
            for held in (self._timers, self._services, self._clients, self._subscriptions, self._publishers, self._guards):
                while held:
                    held.pop().destroy()
            self._entity.undeclare()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.destroy_node()

    # --- graph

    def _graph(self, kind, name):
        return len(self._bus.entities(kind, self.resolve_topic_name(name)))

    def count_publishers(self, topic_name):
        return self._graph('MP', topic_name)

    def count_subscribers(self, topic_name):
        return self._graph('MS', topic_name)

    def count_services(self, name):
        return self._graph('SS', name)

    def count_clients(self, name):
        return self._graph('SC', name)

    def get_node_names_and_namespaces(self):
        return [(p.rpartition('/')[2], p.rpartition('/')[0] or '/') for _, p in self._bus.entities('NN')]

    def get_node_names(self):
        return [n for n, _ in self.get_node_names_and_namespaces()]

    def get_topic_names_and_types(self, no_demangle=False):
        return self._names(('MP', 'MS'))

    def get_service_names_and_types(self):
        return self._names(('SS',))

    def _names(self, kinds):
        out = {}
        for kind in kinds:
            for _, _, name, dds, _ in self._bus.entities(kind):
                out.setdefault(name, set()).add(dds.replace('::dds_::', '::').replace('::', '/').rstrip('_'))
        return [(n, sorted(t)) for n, t in sorted(out.items())]

    def wait_for_node(self, fully_qualified_node_name, timeout):
        return self._bus.wait_graph(lambda: bool(self._bus.entities('NN', fully_qualified_node_name)), timeout)

    # --- parameters

    def declare_parameter(self, name, value=None, descriptor=None, ignore_override=False):
        args = (name,) if value is None and descriptor is None else (name, value, descriptor or ParameterDescriptor())
        return self.declare_parameters('', [args], ignore_override)[0]

    def declare_parameters(self, namespace, parameters, ignore_override=False):
        todo, descriptors = [], {}
        for name, *more in parameters:
            name = f'{namespace}.{name}' if namespace else name
            given = more[0] if more else None
            descriptor = more[1] if len(more) > 1 else ParameterDescriptor()
            if not more:
                warnings.warn(f"declaring parameter '{name}' only providing its name is deprecated")
                descriptor.dynamic_typing = True
            value = given
            if isinstance(given, Parameter.Type):
                value, descriptor.type = None, given.value
            elif not descriptor.dynamic_typing:
                descriptor.type = (given.type if isinstance(given, ParameterValue)
                                   else Parameter.Type.from_parameter_value(given).value)
                if descriptor.type == ParameterType.PARAMETER_NOT_SET:
                    raise ValueError('Cannot declare a statically typed parameter with default value '
                                     'of type PARAMETER_NOT_SET')
            if isinstance(value, ParameterValue):
                value = parameter_value_to_python(value)
            if not ignore_override and name in self._overrides:
                value = self._overrides[name]
            want = Parameter.Type(descriptor.type)
            typed = want != _NOT_SET and isinstance(value, (list, tuple)) and want.check(value)
            todo.append(Parameter(name, want if typed else None, value))
            descriptors[name] = descriptor
        if again := [p.name for p in todo if p.name in self._parameters]:
            raise ParameterAlreadyDeclaredException(again)
        for p in todo:
            result = self._set([p], {p.name: descriptors[p.name]}, declaring=True)
            if result.reason.startswith('Wrong parameter type'):
                raise InvalidParameterTypeException(p, Parameter.Type(descriptors[p.name].type).name)
            if not result.successful:
                raise InvalidParameterValueException(p.name, p.value, result.reason)
        return [self._parameters[p.name] for p in todo]

    def undeclare_parameter(self, name):
        if not self.has_parameter(name):
            raise ParameterNotDeclaredException(name)
        if self._descriptors[name].read_only:
            raise ParameterImmutableException(name)
        del self._parameters[name], self._descriptors[name]

    def has_parameter(self, name):
        return name in self._parameters

    def get_parameter(self, name):
        if (p := self._parameters.get(name)) is not None:
            if p.type_ == _NOT_SET and not self._descriptors[name].dynamic_typing:
                raise ParameterUninitializedException(name)
            return p
        if self._allow_undeclared_parameters:
            return Parameter(name, _NOT_SET)
        raise ParameterNotDeclaredException(name)

    def get_parameters(self, names):
        return [self.get_parameter(n) for n in names]

    def get_parameter_or(self, name, alternative_value=None):
        p = self._parameters.get(name)
        return p if p is not None and p.type_ != _NOT_SET else alternative_value or Parameter(name, _NOT_SET)

    def get_parameter_type(self, name):
        return self.get_parameter(name).type_

    def get_parameters_by_prefix(self, prefix):
        prefix = prefix + '.' if prefix else ''
        return {n[len(prefix):]: p for n, p in self._parameters.items() if n.startswith(prefix)}

    def describe_parameter(self, name):
        if name in self._descriptors:
            return self._descriptors[name]
        if self._allow_undeclared_parameters:
            return ParameterDescriptor()
        raise ParameterNotDeclaredException(name)

    def describe_parameters(self, names):
        return [self.describe_parameter(n) for n in names]

    def set_parameters(self, parameter_list):
        return [self.set_parameters_atomically([p]) for p in parameter_list]

    def set_parameters_atomically(self, parameter_list):
        for callback in self._pre_set:
            parameter_list = callback(parameter_list)
            if not parameter_list:
                return _ok(False, 'parameter list cannot be empty, this might be due to pre_set_parameters_callback '
                                  'modifying the original parameters list.')
        unknown = [p.name for p in parameter_list if p.name not in self._parameters]
        if unknown and not self._allow_undeclared_parameters:
            raise ParameterNotDeclaredException(unknown)
        return self._set(parameter_list, self._descriptors, declaring=False)

    def _set(self, parameters, descriptors, declaring):
        for p in parameters:
            reason = self._refusal(p, descriptors.get(p.name), declaring)
            if reason:
                return _ok(False, reason)
        for callback in self._on_set:
            result = callback(parameters)
            if not result.successful:
                return result
        event = ParameterEvent(node=self.get_fully_qualified_name(), stamp=self._clock.now().to_msg())
        for p in parameters:
            if p.type_ == _NOT_SET and not declaring:
                event.deleted_parameters.append(p.to_parameter_msg())
                self._parameters.pop(p.name, None), self._descriptors.pop(p.name, None)
                continue
            old = self._parameters.get(p.name)
            (event.new_parameters if old is None or old.type_ == _NOT_SET else event.changed_parameters).append(p.to_parameter_msg())
            self._descriptors[p.name] = descriptors.get(p.name) or ParameterDescriptor(name=p.name, dynamic_typing=True)
            self._parameters[p.name] = p
        self._parameter_events.publish(event)
        for callback in self._post_set:
            callback(parameters)
        return _ok()

    def _refusal(self, p, d, declaring):
        if d is None:
            return ''
        d.name = p.name
        if d.read_only and not declaring:
            return f'Trying to set a read-only parameter: {p.name}.'
        if d.dynamic_typing:
            d.type = p.type_.value
        elif p.type_ == _NOT_SET:
            return '' if declaring else 'Static parameter cannot be undeclared'
        elif p.type_.value != d.type:
            return f"Wrong parameter type, expected '{Parameter.Type(d.type)}' got '{p.type_}'"
        for kind, ranges in ((Parameter.Type.INTEGER, d.integer_range), (Parameter.Type.DOUBLE, d.floating_point_range)):
            for r in ranges[:1] if p.type_ == kind else ():
                low, high = min(r.from_value, r.to_value), max(r.from_value, r.to_value)
                near = any(isclose(p.value, x, rel_tol=1e-6) for x in (low, high))
                if not (low <= p.value <= high or near):
                    return (f'Parameter {p.name} out of range. Min: {r.from_value}, Max: {r.to_value}, value: {p.value}')
                steps = (p.value - r.from_value) / r.step if r.step else 0
                if not near and not isclose(steps, round(steps), rel_tol=1e-6):
                    return f'The parameter value for {p.name} is not a valid step. Step: {r.step}, value: {p.value}'
        return ''

    def add_pre_set_parameters_callback(self, callback):
        self._pre_set.insert(0, callback)

    def add_on_set_parameters_callback(self, callback):
        self._on_set.insert(0, callback)

    def add_post_set_parameters_callback(self, callback):
        self._post_set.insert(0, callback)

    def remove_on_set_parameters_callback(self, callback):
        self._on_set.remove(callback)

    def remove_post_set_parameters_callback(self, callback):
        self._post_set.remove(callback)

    def list_parameters(self, prefixes, depth):
        out = ListParametersResult()
        for name in self._parameters:
            for prefix in prefixes or ['']:
                rest = name[len(prefix):].lstrip('.') if prefix else name
                if (not prefix or name == prefix or name.startswith(prefix + '.')) and (not depth or rest.count('.') < depth):
                    out.names.append(name)
                    head = name.rpartition('.')[0]
                    if head and head not in out.prefixes:
                        out.prefixes.append(head)
                    break
        return out

    def _start_parameter_services(self):
        def serve(kind, name, answer):
            def callback(request, response):
                answer(request, response)
                return response
            self.create_service(kind, f'~/{name}', callback, qos_profile=qos_profile_parameters)

        def known(names):
            return [n for n in names if n in self._parameters or self._allow_undeclared_parameters]

        def put(response, **values):
            for key, value in values.items():
                setattr(response, key, value)

        def set_one(p):
            try:
                return self.set_parameters_atomically([Parameter.from_parameter_msg(p)])
            except ParameterNotDeclaredException as error:
                return _ok(False, str(error))

        def set_all(request):
            try:
                return self.set_parameters_atomically([Parameter.from_parameter_msg(p) for p in request.parameters])
            except ParameterNotDeclaredException as error:
                return _ok(False, str(error))
        serve(GetParameters, 'get_parameters', lambda q, r: put(
            r, values=[self.get_parameter_or(n).get_parameter_value() for n in known(q.names)]))
        serve(GetParameterTypes, 'get_parameter_types', lambda q, r: put(
            r, types=[self.get_parameter_or(n).type_.value for n in known(q.names)]))
        serve(DescribeParameters, 'describe_parameters', lambda q, r: put(r, descriptors=self.describe_parameters(known(q.names))))
        serve(ListParameters, 'list_parameters', lambda q, r: put(r, result=self.list_parameters(q.prefixes, q.depth)))
        serve(SetParameters, 'set_parameters', lambda q, r: put(r, results=[set_one(p) for p in q.parameters]))
        serve(SetParametersAtomically, 'set_parameters_atomically', lambda q, r: put(r, result=set_all(q)))

    def _follow_clock(self, parameters):
        for p in parameters:
            if p.name == 'use_sim_time':
                if p.value and self._clock_subscription is None:
                    from rosgraph_msgs.msg import Clock
                    self._clock.set_ros_time_override(Time(clock_type=self._clock.clock_type))
                    self._clock_subscription = self.create_subscription(
                        Clock, '/clock', self._on_clock, QoSProfile(depth=1, reliability=2), callback_group=ReentrantCallbackGroup())
                elif not p.value and self._clock_subscription is not None:
                    self.destroy_subscription(self._clock_subscription)
                    self._clock_subscription = None
                    self._clock.set_ros_time_override(None)

    def _on_clock(self, msg):
        self._clock.set_ros_time_override(Time.from_msg(msg.clock))


def _qos(qos):
    if isinstance(qos, int):
        if qos < 0:
            raise ValueError('history depth must be greater than or equal to zero')
        return QoSProfile(depth=qos)
    if not isinstance(qos, QoSProfile):
        raise TypeError(f'Expected QoSProfile or int, but received {type(qos)!r}')
    return qos
