import numpy as np
import pytest

from octn_ros.errors import ExecutionError
from octn_ros.simulation import LaserPath


def values(count=4):
    return {
        "waypoints_ee": np.tile(np.eye(4), (count, 1, 1)),
        "segment": np.zeros(count, np.int32),
        "laser_on": np.ones(count, bool),
        "speed_m_s": np.full(count, 0.01),
        "stamp_ns": 7,
        "frame": "tool0",
        "hash": "ab12" * 4,
    }


def test_arrays_are_kept_apart_from_the_callers():
    given = values()
    path = LaserPath(**given)
    given["waypoints_ee"][0, 0, 3] = 5.0
    assert path.waypoints_ee[0, 0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        path.speed_m_s[0] = 1.0


def test_an_empty_path_can_be_made():
    assert len(LaserPath(**values(0))) == 0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("waypoints_ee", np.zeros((4, 3, 4)), r"waypoints: expected poses of shape \(4, 4, 4\)"),
        ("segment", np.zeros(3), "segment for 4 waypoints"),
        ("laser_on", np.zeros(5), "laser_on for 4 waypoints"),
        ("speed_m_s", [0.01, 0.01, 0.0, 0.01], "speeds of at least 1e-06 m/s, got 0 at waypoint 2"),
        ("speed_m_s", [np.nan] * 4, "speeds of at least"),
        ("speed_m_s", [np.inf] * 4, "got inf at waypoint 0"),
        ("speed_m_s", [9e-7] * 4, "got 9e-07"),
        ("waypoints_ee", np.tile(2 * np.eye(4), (4, 1, 1)), "rigid transforms .* 4 others of 4, the first at index 0"),
        ("waypoints_ee", np.tile(np.diag([1.0, 1, -1, 1]), (4, 1, 1)), "rigid transforms"),
        ("waypoints_ee", np.full((4, 4, 4), np.nan), "finite rigid"),
    ],
)
def test_malformed_paths_are_refused(name, value, message):
    with pytest.raises(ExecutionError, match=message):
        LaserPath(**{**values(), name: value})
