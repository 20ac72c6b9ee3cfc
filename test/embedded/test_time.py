"""Times, durations, clocks, and simulated time."""

import pytest
from builtin_interfaces.msg import Duration as DurationMessage
from builtin_interfaces.msg import Time as TimeMessage
from rclpy.clock import Clock, ClockType, ROSClock
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage


def test_arithmetic():
    assert Time(seconds=1) + Duration(seconds=0.5) == Time(nanoseconds=1_500_000_000)
    assert Time(seconds=2) - Time(seconds=1) == Duration(seconds=1)
    assert Time(seconds=2) - Duration(seconds=1) == Time(seconds=1)
    assert Duration(seconds=1) < Duration(seconds=2)
    assert Duration(seconds=1) != 1
    assert Time(seconds=1.5).seconds_nanoseconds() == (1, 500_000_000)
    with pytest.raises(TypeError, match="different clock types"):
        assert Time(seconds=1) < Time(seconds=1, clock_type=ClockType.ROS_TIME)
    with pytest.raises(ValueError, match="negative"):
        Time(seconds=1) - Duration(seconds=2)
    with pytest.raises(OverflowError):
        Duration(seconds=2**40)
    with pytest.raises(TypeError):
        hash(Time())


def test_messages():
    assert Time(seconds=3, nanoseconds=4).to_msg() == TimeMessage(sec=3, nanosec=4)
    assert Time.from_msg(TimeMessage(sec=3)) == Time(seconds=3, clock_type=ClockType.ROS_TIME)
    assert Duration(seconds=-1.5).to_msg() == DurationMessage(sec=-2, nanosec=500_000_000)


def test_clocks():
    assert isinstance(Clock(clock_type=ClockType.ROS_TIME), ROSClock)
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    assert steady.now() <= steady.now()
    assert steady.now().clock_type == ClockType.STEADY_TIME


def test_timers_and_clocks_follow_simulated_time(nodes, spin_until):
    simulated = [Parameter("use_sim_time", value=True)]
    node, source, ticks = nodes("alpha", parameter_overrides=simulated), nodes("source"), []
    clock = node.get_clock()
    assert clock.ros_time_is_active
    assert clock.now().nanoseconds == 0
    node.create_timer(1.0, lambda: ticks.append(clock.now().nanoseconds / 1e9))
    publisher = source.create_publisher(ClockMessage, "/clock", 10)
    for tenths in range(1000, 1031):
        publisher.publish(ClockMessage(clock=Time(nanoseconds=tenths * 100_000_000).to_msg()))
        spin_until(lambda now=tenths: clock.now().nanoseconds == now * 100_000_000, node)
    spin_until(lambda: len(ticks) == 4, node)
    assert ticks == [100.0, 101.0, 102.0, 103.0]
    node.set_parameters([Parameter("use_sim_time", value=False)])
    assert not clock.ros_time_is_active
    assert clock.now().nanoseconds > 1e18
