"""Executors, callback groups, tasks, timers and guard conditions."""

import contextlib
import signal
import threading

import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.task import Future
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

WAIT_SEC = 120.0
SHORT_SEC = 0.05
EXECUTORS = [SingleThreadedExecutor, MultiThreadedExecutor]


def messages_to(node, callback, group, count=2):
    """Send `count` messages to a subscription in a callback group."""
    node.create_subscription(Int32, "numbers", callback, 10, callback_group=group)
    publisher = node.create_publisher(Int32, "numbers", 10)
    for i in range(count):
        publisher.publish(Int32(data=i))


@pytest.mark.parametrize("executor_class", EXECUTORS)
def test_errors_of_callbacks_come_out_of_spin(nodes, executor_class):
    node = nodes("alpha")

    def fail():
        raise RuntimeError("from a callback")

    node.create_timer(0.001, fail)
    with executor_class() as executor:
        executor.add_node(node)
        with pytest.raises(RuntimeError, match="from a callback"):
            executor.spin()


def test_callbacks_of_a_reentrant_group_run_at_the_same_time(nodes, spin_until):
    node, both, done = nodes("alpha"), threading.Barrier(2), []

    def meet(message):
        both.wait(WAIT_SEC)  # passes only if two callbacks of the one subscription are here
        done.append(message.data)

    messages_to(node, meet, ReentrantCallbackGroup())
    with MultiThreadedExecutor(2) as executor:
        spin_until(lambda: len(done) == 2, node, executor=executor)


def test_callbacks_of_a_mutually_exclusive_group_run_one_after_another(nodes, spin_until):
    node, group = nodes("alpha"), MutuallyExclusiveCallbackGroup()
    running, entered, go_on, done = threading.Lock(), threading.Event(), threading.Event(), []

    def alone(name):
        assert running.acquire(blocking=False), "two callbacks of the group at once"
        entered.set()
        go_on.wait(WAIT_SEC)
        running.release()
        done.append(name)

    node.create_timer(0.001, lambda: alone("timer"), callback_group=group)
    messages_to(node, lambda m: alone("message"), group, count=5)
    free = []
    node.create_timer(0.001, lambda: free.append(entered.is_set()), callback_group=ReentrantCallbackGroup())
    with MultiThreadedExecutor(4) as executor:
        spin_until(lambda: free.count(True) >= 5, node, executor=executor)
        assert not done, "the first callback of the group still runs, the others wait, the rest goes on"
        go_on.set()
        spin_until(lambda: done.count("message") == 5 and "timer" in done, node, executor=executor)


def test_a_timer_whose_group_was_busy_runs_when_it_is_free(nodes):
    """With nothing else to wake it, the spinning thread must learn that the group ended."""
    node, ended, ticked, go_on = nodes("alpha"), threading.Event(), threading.Event(), threading.Event()

    def hold(message):
        go_on.wait(WAIT_SEC)
        ended.set()

    messages_to(node, hold, None, count=1)
    node.create_timer(SHORT_SEC, lambda: ticked.set() if ended.is_set() else None)
    executor = MultiThreadedExecutor(2)
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    go_on.set()
    assert ticked.wait(WAIT_SEC)
    executor.shutdown()
    spinning.join(WAIT_SEC)


def test_a_timer_that_is_always_due_does_not_starve_the_rest(nodes, spin_until):
    node, got, slow = nodes("alpha"), [], threading.Event()
    node.create_timer(0.0001, lambda: slow.wait(0.002))
    other = []
    node.create_timer(0.0001, lambda: other.append(slow.wait(0.002)))
    messages_to(node, got.append, None, count=5)
    spin_until(lambda: len(got) == 5 and other, node)


def test_coroutines_need_ros2(nodes):
    async def later(*given):
        return given

    node = nodes("alpha")
    for make in (
        lambda: node.create_subscription(Int32, "numbers", later, 10),
        lambda: node.create_service(Trigger, "do", later),
        lambda: node.create_timer(1.0, later),
    ):
        with pytest.raises(NotImplementedError, match=r"coroutine .* needs ROS 2"):
            make()
    with pytest.raises(NotImplementedError, match=r"awaiting a Future .* needs ROS 2"):
        Future().__await__()


@pytest.mark.parametrize("executor_class", EXECUTORS)
def test_done_callbacks_run_in_the_executor_of_a_future(nodes, spin_until, executor_class):
    nodes("alpha")
    with executor_class() as executor:
        future, seen = Future(executor=executor), []
        future.add_done_callback(lambda f: seen.append(f.result()))
        future.set_result(41)
        assert not seen
        spin_until(lambda: seen == [41], executor=executor)


def test_futures():
    future, seen = Future(), []
    future.add_done_callback(lambda f: seen.append(f.result()))
    assert (future.done(), future.result()) == (False, None)
    future.set_result(1)
    future.add_done_callback(lambda f: seen.append(f.result()))
    assert seen == [1, 1]
    cancelled = Future()
    cancelled.cancel()
    assert cancelled.cancelled()
    assert cancelled.done()
    failed = Future()
    failed.set_exception(KeyError("x"))
    with pytest.raises(KeyError):
        failed.result()


def test_an_error_in_a_done_callback_is_a_warning_as_in_rclpy():
    future, seen = Future(), []
    future.add_done_callback(lambda f: 1 / 0)
    future.add_done_callback(seen.append)
    with pytest.warns(UserWarning, match="ZeroDivisionError"):
        future.set_result(1)
    assert seen == [future]


def test_spinning_until_a_future_is_done_or_time_is_up(nodes):
    node = nodes("alpha")
    future = Future()
    rclpy.spin_until_future_complete(node, future, timeout_sec=SHORT_SEC)
    assert not future.done()
    timer = node.create_timer(0.001, lambda: future.set_result(timer.cancel()))
    rclpy.spin_until_future_complete(node, future, timeout_sec=WAIT_SEC)
    assert future.done()
    assert timer.is_canceled()
    rclpy.spin_once(node, timeout_sec=0)


def test_timers_cancel_reset_and_keep_their_period(nodes, spin_until):
    node, ticks = nodes("alpha"), []
    timer = node.create_timer(0.01, lambda: ticks.append(node.get_clock().now().nanoseconds), autostart=False)
    assert timer.is_canceled()
    assert timer.time_until_next_call() is None
    timer.reset()
    spin_until(lambda: len(ticks) == 5, node)
    assert ticks[-1] - ticks[0] >= 4 * 10_000_000 * 0.5
    assert timer.timer_period_ns == 10_000_000
    assert node.destroy_timer(timer)
    assert not node.destroy_timer(timer)


def test_wake_ends_a_wait(nodes):
    node, executor = nodes("alpha"), SingleThreadedExecutor()
    executor.add_node(node)
    future = Future()
    spinning = threading.Thread(target=executor.spin_until_future_complete, args=(future,))
    spinning.start()
    executor.wake()
    future.set_result(None)
    spinning.join(WAIT_SEC)
    assert not spinning.is_alive()


def test_a_node_moves_from_one_executor_to_another(nodes):
    node, first, second = nodes("alpha"), SingleThreadedExecutor(), SingleThreadedExecutor()
    assert first.add_node(node)
    assert not first.add_node(node)
    assert second.add_node(node)
    assert (first.get_nodes(), second.get_nodes(), node.executor) == ([], [node], second)
    second.remove_node(node)
    assert node.executor is None


def test_spinning_inside_a_callback_leaves_the_node_where_it_is(nodes, spin_until):
    node, ticks = nodes("alpha"), []

    def tick():
        ticks.append(1)
        rclpy.spin_until_future_complete(node, Future(), executor=executor, timeout_sec=0)

    executor = SingleThreadedExecutor()
    node.create_timer(0.001, tick, callback_group=ReentrantCallbackGroup())
    executor.add_node(node)
    spin_until(lambda: len(ticks) > 2, executor=executor)


@pytest.mark.parametrize("executor_class", EXECUTORS)
def test_shutdown_from_another_thread_ends_spinning(nodes, executor_class):
    node, executor, ended = nodes("alpha"), executor_class(), []

    def spin():
        try:
            rclpy.spin(node, executor)
        except ExternalShutdownException:
            ended.append("context")
        else:
            ended.append("executor")

    for stop, how in ((executor.shutdown, "executor"), (rclpy.shutdown, "context")):
        if how == "context":
            executor = executor_class()
        spinning = threading.Thread(target=spin)
        spinning.start()
        stop()
        spinning.join(WAIT_SEC)
        assert not spinning.is_alive()
    assert ended[0] == "executor"


def test_shutdown_tells_whether_callbacks_ended(nodes):
    node, entered, go_on = nodes("alpha"), threading.Event(), threading.Event()

    def hold():
        entered.set()
        go_on.wait(WAIT_SEC)

    node.create_timer(0.001, hold)
    executor = MultiThreadedExecutor(1)
    executor.add_node(node)
    while not entered.wait(SHORT_SEC):
        executor.spin_once(timeout_sec=SHORT_SEC)
    assert not executor.shutdown(timeout_sec=SHORT_SEC)
    go_on.set()
    assert executor.shutdown(timeout_sec=WAIT_SEC)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_spinning_and_handlers_are_put_back(nodes, number):
    before = signal.getsignal(number)
    node = nodes("alpha")
    node.create_timer(0.001, lambda: signal.raise_signal(number))
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    assert not rclpy.ok()
    rclpy.try_shutdown()
    assert signal.getsignal(number) is before
