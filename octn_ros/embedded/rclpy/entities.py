"""What a node holds: publishers, subscriptions, clients, services, timers, guard conditions."""
import inspect
import time
from collections import deque
from threading import Event, Lock

from octn_ros.embedded import idl, message, wire

from .duration import Duration
from .executors import await_or_execute
from .task import Future
from .time import Time


class _Waitable:
    """Has a bounded queue of what arrived; while that is not empty, stands once in its executor's queue."""

    _posted = None  # the executor whose queue has it

    def __init__(self, node, callback, callback_group, depth=None):
        self._node, self.callback, self.callback_group = node, callback, callback_group or node.default_callback_group
        self.callback_group.add_entity(self)
        self._queue = deque(maxlen=depth)

    def _arrived(self, item):
        self._queue.append(item)
        self._notify()

    def _notify(self):
        executor = self._node.executor
        if executor is not None and self._posted is not executor:
            self._posted = executor
            executor._post(self)

    def _pop(self):
        try:
            return self._queue.popleft()
        except IndexError:
            return None


class Publisher:
    def __init__(self, node, msg_type, topic, qos):
        self._node, self.msg_type, self.topic, self.qos_profile = node, msg_type, topic, qos
        self._entity = wire.Entity(node._bus, node._entity, 'MP', topic, idl.dds_name(msg_type._ROS_TYPE),
                                   idl.type_hash(msg_type._ROS_TYPE), qos)
        self._publisher, self._lock = node._bus.publisher(self._entity, qos), Lock()
        self._entity.announce()

    topic_name = property(lambda self: self.topic)

    def publish(self, msg):
        if isinstance(msg, self.msg_type):
            data = message.serialize(msg)
        elif isinstance(msg, bytes):
            data = msg
        else:
            raise TypeError(f'Expected {self.msg_type}, got {type(msg)}')
        with self._lock:  # numbers must go out in order
            self._publisher.put(data, attachment=self._entity.attachment())

    def get_subscription_count(self):
        return len(self._node._bus.entities('MS', self.topic))

    def assert_liveliness(self):
        pass

    def wait_for_all_acked(self, timeout=Duration(seconds=-1)):
        return True

    def destroy(self):
        self._entity.undeclare()
        self._publisher.undeclare()


class Subscription(_Waitable):
    def __init__(self, node, msg_type, topic, callback, qos, callback_group, raw):
        super().__init__(node, callback, callback_group, None if qos.history == 2 else qos.depth or 42)
        self.msg_type, self.topic, self.qos_profile, self.raw = msg_type, topic, qos, raw
        self._with_info = _takes_info(callback)
        self._entity = wire.Entity(node._bus, node._entity, 'MS', topic, idl.dds_name(msg_type._ROS_TYPE),
                                   idl.type_hash(msg_type._ROS_TYPE), qos)
        self._subscriber = node._bus.subscriber(self._entity, qos, self._arrived)
        self._entity.announce()

    topic_name = property(lambda self: self.topic)

    def _take(self):
        sample = self._pop()
        if sample is None:
            return None
        data = sample.payload.to_bytes()
        args = [data if self.raw else message.deserialize(data, self.msg_type)]
        if self._with_info:
            seq, stamp, gid = wire.read_attachment(sample.attachment)
            args.append({'source_timestamp': stamp, 'received_timestamp': time.time_ns(),
                         'publication_sequence_number': seq, 'publisher_gid': gid})
        return lambda: await_or_execute(self.callback, *args)

    def get_publisher_count(self):
        return len(self._node._bus.entities('MP', self.topic))

    def destroy(self):
        self._entity.undeclare()
        self._subscriber.undeclare()


def _takes_info(callback):
    try:
        inspect.signature(callback).bind(None)
    except TypeError:
        return True
    except ValueError:  # a builtin without a signature
        pass
    return False


class Service(_Waitable):
    def __init__(self, node, srv_type, name, callback, qos, callback_group):
        super().__init__(node, callback, callback_group)
        self.srv_type, self.srv_name, self.qos_profile = srv_type, name, qos
        bus = node._bus
        self._entity = wire.Entity(bus, node._entity, 'SS', name, idl.dds_name(srv_type._ROS_TYPE),
                                   idl.type_hash(srv_type._ROS_TYPE), qos)
        self._queryable = bus.queryable(self._entity, self._arrived)
        self._entity.announce()

    service_name = property(lambda self: self.srv_name)

    def _take(self):
        query = self._pop()
        if query is None:
            return None
        request = message.deserialize(query.payload.to_bytes(), self.srv_type.Request)
        header = wire.read_attachment(query.attachment)

        async def work():
            response = await await_or_execute(self.callback, request, self.srv_type.Response())
            if not isinstance(response, self.srv_type.Response):
                raise TypeError(f'Expected {self.srv_type.Response}, got {type(response)}')
            wire.reply(query, self._entity.key, message.serialize(response), header)
        return work

    def destroy(self):
        self._entity.undeclare()
        self._queryable.undeclare()


class Client(_Waitable):
    def __init__(self, node, srv_type, name, qos, callback_group):
        super().__init__(node, None, callback_group)
        self.srv_type, self.srv_name, self.qos_profile, self._pending = srv_type, name, qos, set()
        self._entity = wire.Entity(node._bus, node._entity, 'SC', name, idl.dds_name(srv_type._ROS_TYPE),
                                   idl.type_hash(srv_type._ROS_TYPE), qos)
        self._entity.announce()

    service_name = property(lambda self: self.srv_name)

    def call_async(self, request):
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f'Expected {self.srv_type.Request}, got {type(request)}')
        future = Future()
        self._pending.add(future)
        future._add_waiter(lambda: self._pending.discard(future))
        self._node._bus.request(self._entity, message.serialize(request), self._entity.attachment(),
                                lambda reply: reply.ok and self._arrived((future, reply.ok)))
        return future

    def call(self, request, timeout_sec=None):
        done, future = Event(), self.call_async(request)
        future._add_waiter(done.set)
        if not done.wait(timeout_sec):
            self.remove_pending_request(future)
            raise TimeoutError
        if future.exception() is not None:
            raise future.exception()
        return future.result()

    def remove_pending_request(self, future):
        self._pending.discard(future)

    def _take(self):
        item = self._pop()
        if item is None or item[0] not in self._pending:
            return None
        future, response = item[0], message.deserialize(item[1].payload.to_bytes(), self.srv_type.Response)

        async def work():
            future._set_executor(self._node.executor)
            future.set_result(response)
        return work

    def service_is_ready(self):
        return bool(self._node._bus.entities('SS', self.srv_name))

    def wait_for_service(self, timeout_sec=None):
        end = None if timeout_sec is None else time.monotonic() + timeout_sec
        while self._node.context.ok() and not self.service_is_ready():
            left = 0.25 if end is None else min(end - time.monotonic(), 0.25)
            if left <= 0:
                return False
            self._node._bus.wait_graph(self.service_is_ready, left)
        return self.service_is_ready()

    def destroy(self):
        self._entity.undeclare()


class Timer(_Waitable):
    def __init__(self, node, callback, callback_group, period_ns, clock, autostart):
        super().__init__(node, callback, callback_group)
        self.timer_period_ns, self.clock, self._canceled = period_ns, clock, not autostart
        self._next = self._last = clock._ns()
        self.reset() if autostart else None

    def _seconds_left(self):
        return None if self._canceled else (self._next - self.clock._ns()) / 1e9 if not getattr(
            self.clock, 'ros_time_is_active', False) or self._next <= self.clock._ns() else 3600.0

    def _take(self):
        now = self.clock._ns()
        if self._canceled or now < self._next:
            return None
        self._last = now
        self._next += self.timer_period_ns
        if self._next < now:  # late by more than a period: skip, keeping the phase
            missed = (now - self._next) // self.timer_period_ns + 1 if self.timer_period_ns else 0
            self._next = self._next + missed * self.timer_period_ns if self.timer_period_ns else now
        return lambda: await_or_execute(self.callback)

    def cancel(self):
        self._canceled = True

    def is_canceled(self):
        return self._canceled

    def is_ready(self):
        return not self._canceled and self.clock._ns() >= self._next

    def reset(self):
        self._next, self._canceled = self.clock._ns() + self.timer_period_ns, False
        if self._node.executor is not None:
            self._node.executor.wake()

    def time_since_last_call(self):
        return self.clock._ns() - self._last

    def time_until_next_call(self):
        return None if self._canceled else self._next - self.clock._ns()

    def destroy(self):
        self._canceled = True


class GuardCondition(_Waitable):
    def trigger(self):
        if not self._queue:
            self._arrived(True)

    def _take(self):
        return (lambda: await_or_execute(self.callback)) if self._pop() else None

    def destroy(self):
        self._queue.clear()


class Rate:
    def __init__(self, node, frequency, clock):
        self._node, self._clock, self._period = node, clock, int(1e9 / frequency)
        self._next = clock._ns() + self._period

    def sleep(self):
        if not self._node.context.ok():
            from .exceptions import ROSInterruptException
            raise ROSInterruptException()
        self._clock.sleep_until(Time(nanoseconds=self._next, clock_type=self._clock.clock_type), self._node.context)
        self._next = max(self._next, self._clock._ns() - self._period) + self._period

    def destroy(self):
        pass


__all__ = ['Client', 'GuardCondition', 'Publisher', 'Rate', 'Service', 'Subscription', 'Timer']
