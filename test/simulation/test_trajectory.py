import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from octn_ros.errors import ConfigurationError, ExecutionError
from octn_ros.simulation import MotionLimits, Trajectory

LIMITS = MotionLimits()
FOCUS_SPEED_M_S = 5e-3


def posed(place, *degrees):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", degrees or (0, 0, 0), degrees=True).as_matrix()
    pose[:3, 3] = place
    return pose


EE2LASER = posed((0.01, -0.02, -0.12), 3, -4, 10)
HERE = np.eye(4)


def trajectory(poses, speed=FOCUS_SPEED_M_S, ee2laser=HERE, limits=LIMITS, **options):
    poses = np.asarray(poses)
    return Trajectory(poses, np.full(len(poses) - 1, speed), ee2laser, limits, **options)


def sampled(motion, ee2laser, dt_s):
    """Largest speed and acceleration of focus, tool and orientation, by differences."""
    focus = motion.focus_at(np.arange(0.0, motion.duration_s + dt_s, dt_s))
    tool = np.diff((focus @ ee2laser)[:, :3, 3], axis=0) / dt_s
    turns = np.swapaxes(focus[:-1, :3, :3], 1, 2) @ focus[1:, :3, :3]
    turning = np.einsum("nij,nj->ni", focus[:-1, :3, :3], Rotation.from_matrix(turns).as_rotvec()) / dt_s
    return {
        "focus": np.linalg.norm(np.diff(focus[:, :3, 3], axis=0), axis=1).max() / dt_s,
        "tool": np.linalg.norm(tool, axis=1).max(),
        "acceleration": np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / dt_s,
        "turn": np.degrees(np.linalg.norm(turning, axis=1).max()),
        "turn acceleration": np.degrees(np.linalg.norm(np.diff(turning, axis=0), axis=1).max() / dt_s),
    }


def test_a_straight_way_is_a_trapezoid():
    motion = trajectory([posed((0, 0, 0)), posed((0.2, 0, 0))], speed=1.0)
    v, a = LIMITS.max_speed_m_s, LIMITS.max_acceleration_m_s2
    # Gather, go on, lose: L / v + v / a, and a little for the twelfths of the way between which the law is made.
    assert motion.duration_s == pytest.approx(0.2 / v + v / a, rel=0.07)
    assert motion.focus_at(0.1)[0, 3] == pytest.approx(0.5 * a * 0.1**2, rel=0.05)


def test_a_way_too_short_for_the_speed_is_a_triangle():
    motion = trajectory([posed((0, 0, 0)), posed((1e-3, 0, 0))], speed=1.0)
    assert motion.duration_s == pytest.approx(2.0 * np.sqrt(1e-3 / LIMITS.max_acceleration_m_s2), rel=1e-6)


def test_a_turn_in_place_is_limited_by_the_angular_limits():
    motion = trajectory([posed((0, 0, 0)), posed((0, 0, 0), 0, 0, 120)])
    w, alpha = LIMITS.max_turn_deg_s, LIMITS.max_turn_acceleration_deg_s2
    assert motion.duration_s == pytest.approx(120 / w + w / alpha, rel=0.07)
    seen = sampled(motion, HERE, 1e-3)
    assert seen["turn"] <= w * 1.001
    assert seen["turn acceleration"] <= alpha * 1.01


@examples(max_examples=15)
@given(st.integers(0, 10_000), st.floats(0.0, 4.0), st.floats(0.0, 10e-6))
def test_every_limit_holds_and_every_pose_is_passed(seed, lean_deg, rough_m):
    """Three lines of a zigzag over a rough surface, the beam leaning anyhow, with a long way there."""
    generator = np.random.default_rng(seed)
    rows, columns = np.divmod(np.arange(24), 8)
    columns = np.where(rows % 2 == 0, columns, 7 - columns)
    poses = [posed((0.03, 0.0, 0.05), 0, 0, 60)]
    for row, column in zip(rows, columns, strict=True):
        place = 60e-6 * column, 60e-6 * row, rough_m * generator.normal()
        poses.append(posed(place, *(lean_deg * generator.normal(size=2)), 0))
    motion = trajectory(poses, ee2laser=EE2LASER)
    np.testing.assert_allclose(motion.focus_at(motion.times_s), poses, atol=1e-9)
    assert (np.diff(motion.times_s) > 0).all()
    seen = sampled(motion, EE2LASER, motion.duration_s / 40_000)
    # Between the places at which the law is made, quantities are a little off it.
    assert seen["focus"] <= FOCUS_SPEED_M_S * 1.03
    assert seen["tool"] <= LIMITS.max_speed_m_s * 1.03
    assert seen["acceleration"] <= LIMITS.max_acceleration_m_s2 * 1.05
    assert seen["turn"] <= LIMITS.max_turn_deg_s * 1.03
    assert seen["turn acceleration"] <= LIMITS.max_turn_acceleration_deg_s2 * 1.05


def test_waypoints_of_a_line_are_passed_without_a_halt():
    line = [posed((50e-6 * i, 0, 5e-6 * (i % 2))) for i in range(40)]
    motion = trajectory(line)
    speed = np.linalg.norm(
        np.diff(motion.focus_at(np.linspace(*motion.times_s[[2, -3]], 2000))[:, :3, 3], axis=0), axis=1
    )
    assert speed.min() > 0.5 * speed.max()
    straight = 39 * 50e-6 / FOCUS_SPEED_M_S
    assert straight < motion.duration_s < 1.15 * straight


def test_the_motion_halts_at_sharp_turns_and_where_told_to():
    corner = [posed((0, 0, 0)), posed((1e-3, 0, 0)), posed((1e-3, 1e-3, 0))]
    motion = trajectory(corner)
    at, step = motion.times_s[1], 1e-6
    assert np.linalg.norm(motion.focus_at(at + step)[:3, 3] - motion.focus_at(at - step)[:3, 3]) < 1e-11
    waiting = trajectory(corner, pauses_s=np.array([0.0, 0.25, 0.0]))
    assert waiting.duration_s == pytest.approx(motion.duration_s + 0.25)
    np.testing.assert_allclose(waiting.focus_at([at, at + 0.1, at + 0.25]), [corner[1]] * 3, atol=1e-12)


def test_the_arm_rests_before_and_after():
    motion = trajectory([posed((0, 0, 0)), posed((1, 0, 0))])
    assert motion.focus_at(-1.0)[0, 3] == 0.0
    assert motion.focus_at(motion.duration_s + 5.0)[0, 3] == 1.0
    assert [motion.reached(t) for t in (0.0, 0.5 * motion.duration_s, motion.duration_s)] == [1, 1, 2]


def test_poses_may_repeat():
    motion = trajectory([posed((0, 0, 0))] * 3 + [posed((1e-3, 0, 0))] * 2)
    np.testing.assert_allclose(motion.focus_at(motion.duration_s)[:3, 3], (1e-3, 0, 0), atol=1e-12)
    alone = Trajectory(posed((1, 2, 3))[None], np.zeros(0), HERE, LIMITS)
    assert alone.duration_s == 0.0
    np.testing.assert_array_equal(alone.focus_at(1.0)[:3, 3], (1, 2, 3))


def test_a_motion_that_would_never_end_is_refused():
    poses = np.array([posed((x, 0, 0)) for x in (0.0, 0.0, 0.1, 0.2, 0.3)])
    speeds = np.array([0.1, 1e-12, 0.1, 0.1])
    with pytest.raises(ExecutionError, match=r"finite time, got legs of 1e-09 to 0.1 m at 1e-12 to 0.1 m/s"):
        Trajectory(poses, speeds, HERE, LIMITS)


def test_legs_that_take_no_time_beside_all_before_are_passed():
    poses = np.array([posed((x, 0, 0)) for x in (0.0, 1.0, 1.0, 1.0, 2.0)])
    motion = trajectory(poses, speed=1e-6, pauses_s=np.array([0.0, 0.0, 1.0, 0.0, 0.0]))
    focus = motion.focus_at(motion.times_s[2] + np.array([-1.0, 0.5, 2.0]))
    np.testing.assert_allclose(focus[:, 0, 3], 1.0, atol=1e-5)


def test_limits_are_checked():
    with pytest.raises(ConfigurationError, match="max_acceleration_m_s2"):
        MotionLimits(max_acceleration_m_s2=0.0)
