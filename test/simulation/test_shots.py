import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octn_ros.simulation import LaserPath, ShotSchedule
from octn_ros.simulation.shots import lone_waypoints

DWELL_S = 4e-3


def path(laser_on, segment):
    count = len(laser_on)
    return LaserPath(np.tile(np.eye(4), (count, 1, 1)), segment, laser_on, np.full(count, 5e-3), 1, "tool0")


def test_shots_lie_about_their_waypoints_and_inside_their_line():
    lines = path([1] * 8, [0] * 4 + [1] * 4)
    at_s = np.arange(8) * 10e-3
    schedule = ShotSchedule.of(lines, at_s, DWELL_S)
    np.testing.assert_array_equal(schedule.waypoint, np.arange(8))
    np.testing.assert_allclose(schedule.end_s - schedule.start_s, DWELL_S)
    middle = 0.5 * (schedule.start_s + schedule.end_s) - at_s
    np.testing.assert_allclose(middle, np.array([2, 0, 0, -2, 2, 0, 0, -2]) * 1e-3, atol=1e-12)
    np.testing.assert_allclose(schedule.gate_s, [[0.0, 30e-3], [40e-3, 70e-3]])
    assert [schedule.open_at(t) for t in (0.0, 0.029, 0.03, 0.035, 0.04, 0.07)] == [
        True,
        True,
        False,
        False,
        True,
        False,
    ]


def test_a_burst_that_is_too_long_ends_half_way_to_the_next_waypoint():
    schedule = ShotSchedule.of(path([1] * 4, [0] * 4), np.arange(4) * 10e-3, 1.0)
    np.testing.assert_allclose(schedule.end_s - schedule.start_s, [5e-3, 10e-3, 10e-3, 5e-3])


def test_a_waypoint_alone_is_fired_at_from_its_time_on():
    alone = path([0, 1, 0, 1, 1, 1], [0, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(lone_waypoints(alone), [0, 1, 0, 0, 0, 1])
    schedule = ShotSchedule.of(alone, np.arange(6) * 10e-3, DWELL_S)
    assert schedule.start_s[0] == pytest.approx(10e-3)
    np.testing.assert_allclose(schedule.end_s - schedule.start_s, DWELL_S)
    np.testing.assert_allclose(schedule.gate_s, [[10e-3, 14e-3], [30e-3, 40e-3], [50e-3, 54e-3]])


def test_a_path_that_never_fires_has_no_shots():
    schedule = ShotSchedule.of(path([0, 0], [0, 0]), np.array([0.0, 1.0]), DWELL_S)
    assert len(schedule.waypoint) == 0
    assert not schedule.open_at(0.5)


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.floats(1e-4, 0.05)), min_size=1, max_size=30))
def test_shots_never_overlap_nor_leave_the_open_shutter(points):
    laser_on = [on for on, _, _ in points]
    segment = np.cumsum([new for _, new, _ in points])
    lines = path(laser_on, segment)
    # The arm halts for as long as the burst takes where a waypoint fires alone.
    gaps = np.array([gap for _, _, gap in points])
    waits = np.where(lone_waypoints(lines), DWELL_S, 0.0)
    at_s = np.cumsum(gaps) + np.concatenate(([0.0], np.cumsum(waits)[:-1]))
    schedule = ShotSchedule.of(lines, at_s, DWELL_S)
    np.testing.assert_array_equal(schedule.waypoint, np.flatnonzero(laser_on))
    assert (schedule.end_s >= schedule.start_s).all()
    assert (schedule.end_s - schedule.start_s <= DWELL_S + 1e-12).all()
    assert (schedule.start_s[1:] >= schedule.end_s[:-1] - 1e-12).all()
    for start, end in zip(schedule.start_s, schedule.end_s, strict=True):
        assert any(opens - 1e-12 <= start and end <= closes + 1e-12 for opens, closes in schedule.gate_s)
