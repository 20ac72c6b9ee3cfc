import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octn_ros.simulation.trajectory import Trajectory


def poses(positions, rotations=None):
    result = np.tile(np.eye(4), (len(positions), 1, 1))
    result[:, :3, 3] = positions
    if rotations is not None:
        result[:, :3, :3] = rotations.as_matrix()
    return result


def test_the_slower_of_focus_and_tool_sets_the_time_of_a_leg():
    tool = poses([(0, 0, 0), (0.1, 0, 0), (0.1, 0, 0), (0.1, 0, 0)])
    focus = np.array([(0, 0, 0), (0.01, 0, 0), (0.06, 0, 0), (0.06, 0, 0)])
    trajectory = Trajectory.through(tool, focus, np.array([0.1, 0.1, 0.1]), 0.2)
    np.testing.assert_allclose(trajectory.times_s, [0.0, 0.5, 1.0, 1.0])
    assert trajectory.duration_s == 1.0


def test_position_and_orientation_move_evenly():
    turn = Rotation.from_euler("z", [[0.0], [90.0]], degrees=True)
    trajectory = Trajectory(poses([(0, 0, 0), (2, 4, 0)], turn), np.array([0.0, 4.0]))
    pose = trajectory.pose_at(1.0)
    np.testing.assert_allclose(pose[:3, 3], [0.5, 1.0, 0.0])
    assert Rotation.from_matrix(pose[:3, :3]).as_euler("zyx", degrees=True) == pytest.approx([22.5, 0, 0])


def test_the_arm_rests_before_and_after():
    trajectory = Trajectory(poses([(0, 0, 0), (1, 0, 0)]), np.array([0.0, 1.0]))
    assert trajectory.pose_at(-1.0)[0, 3] == 0.0
    assert trajectory.pose_at(5.0)[0, 3] == 1.0
    assert [trajectory.reached(t) for t in (0.0, 0.5, 1.0)] == [1, 1, 2]
