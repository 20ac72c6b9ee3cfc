import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octn_ros.errors import ConfigurationError, ExecutionError
from octn_ros.simulation import Arm, ArmConfig, LaserPath

SCAN_NS = 1_000_000_000
SPACING_M = 50e-6
DWELL_S = 1e-3
LINES, POINTS = 3, 5
COUNT = LINES * POINTS


def posed(x, y, z, *degrees):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


SCAN_POSE = posed(0.4, 0.1, 0.3, 175, 5, 30)
LASER2EE = posed(0.02, -0.01, 0.12, 3, -4, 10)


def zigzag(**changes):
    """Three lines of five points, the beam leaning a little differently at each; the turns are dark."""
    rows, columns = np.divmod(np.arange(COUNT), POINTS)
    columns = np.where(rows % 2 == 0, columns, POINTS - 1 - columns)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    angles = 0.2 * np.stack([columns, rows], axis=1)
    poses[:, :3, :3] = Rotation.from_euler("xy", angles, degrees=True).as_matrix()
    poses[:, :3, 3] = SPACING_M * np.stack([columns + 1, rows + 1, np.ones(COUNT)], axis=1)
    values = {
        "waypoints_ee": LASER2EE @ poses,
        "segment": rows,
        "laser_on": np.ones(COUNT, bool),
        "speed_m_s": np.full(COUNT, 0.01),
        "stamp_ns": SCAN_NS,
        "frame": "tool0",
    }
    return LaserPath(**{**values, **changes})


def expected_spots(path):
    return (SCAN_POSE @ path.waypoints_ee)[:, :3, 3]


@pytest.fixture
def arm():
    return Arm(ArmConfig(), LASER2EE, SCAN_POSE)


def run(arm, path, dt_s=None, most_steps=20_000):
    arm.stage(path, SCAN_NS, SCAN_POSE)
    arm.execute(SCAN_NS + 1, DWELL_S)
    shots = []
    for _ in range(most_steps):
        shots += arm.step(dt_s)
        if arm.state != "executing":
            return shots
    raise AssertionError(f"expected the end of the path in {most_steps} steps, at {arm.progress}")


@pytest.mark.parametrize("dt_s", [1e-4, 0.008, 10.0])
def test_every_shot_is_fired_once_about_its_waypoint(arm, dt_s):
    path = zigzag()
    shots = run(arm, path, dt_s)
    assert (arm.state, arm.executed, arm.progress) == ("done", COUNT, (COUNT, COUNT))
    assert [shot.waypoint for shot in shots] == list(range(COUNT))
    assert [shot.dwell_s for shot in shots] == pytest.approx([DWELL_S] * COUNT)
    fired = np.array([shot.focus2base[:3, 3] for shot in shots])
    off = np.linalg.norm(fired - expected_spots(path), axis=1)
    ends = np.isin(np.arange(COUNT) % POINTS, (0, POINTS - 1))
    # At the ends of a line the burst lies inside the line, where the arm still gathers or loses speed.
    assert off[~ends].max() < 1e-7
    assert off[ends].max() < 0.5 * 1.0 * (DWELL_S / 2) ** 2 + 1e-7
    np.testing.assert_array_equal([shot.planned2base[:3, 3] for shot in shots], expected_spots(path))
    assert not arm.laser_on


def test_the_focus_goes_through_the_waypoints_with_the_beam_as_planned(arm):
    path = zigzag()
    run(arm, path, 1e-4)
    focus = np.array([sample.ee2base @ LASER2EE for sample in arm.history])
    spots = SCAN_POSE @ path.waypoints_ee
    for spot in spots:
        distance = np.linalg.norm(focus[:, :3, 3] - spot[:3, 3], axis=1)
        nearest = int(np.argmin(distance))
        # Within one step at 10 mm/s; the beam turns by 0.2 degrees from waypoint to waypoint.
        assert distance[nearest] < 1.1e-6
        assert np.degrees(np.arccos(np.clip(focus[nearest, :3, 2] @ spot[:3, 2], -1, 1))) < 0.01


@pytest.mark.parametrize("limits", [{}, {"max_speed_m_s": 0.005, "max_acceleration_m_s2": 0.1}])
def test_neither_focus_nor_tool_is_faster_than_allowed(limits):
    arm = Arm(ArmConfig(**limits), LASER2EE, SCAN_POSE)
    dt_s = 2e-4
    run(arm, zigzag(), dt_s)
    poses = np.array([SCAN_POSE, *(sample.ee2base for sample in arm.history)])[:-2]
    tool = np.diff(poses[:, :3, 3], axis=0) / dt_s
    assert np.linalg.norm(tool, axis=1).max() <= arm.config.max_speed_m_s * 1.005
    assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / dt_s <= arm.config.max_acceleration_m_s2 * 1.03
    lit = np.array([sample.laser_on for sample in arm.history])[:-2]
    focus = np.linalg.norm(np.diff((poses @ LASER2EE)[:, :3, 3], axis=0), axis=1) / dt_s
    # A lit step after a dark one began before the first waypoint of its line.
    assert focus[1:][lit[1:] & lit[:-1]].max() <= 0.01 * 1.001


def test_history_is_timed_and_dark_on_turns_and_on_the_way_there_and_back(arm):
    run(arm, zigzag(), 1e-4)
    times = np.array([sample.time_ns for sample in arm.history])
    lit = np.array([sample.laser_on for sample in arm.history])
    assert times[0] == SCAN_NS + 1 + 100_000
    assert (np.diff(times) > 0).all()
    assert not lit[0]
    assert not lit[-1]
    stretches = np.flatnonzero(np.diff(lit.astype(int)) == 1)
    assert len(stretches) == LINES, "lit once for each line"
    np.testing.assert_allclose(arm.ee2base, SCAN_POSE, atol=1e-12)


def test_dark_waypoints_are_passed_without_a_shot_and_a_lone_one_is_halted_at(arm):
    laser_on = np.isin(np.arange(COUNT), (0, 1, 7, 12))
    path = zigzag(laser_on=laser_on)
    shots = run(arm, path)
    assert [shot.waypoint for shot in shots] == [0, 1, 7, 12]
    for shot in shots[2:]:
        np.testing.assert_allclose(shot.focus2base[:3, 3], expected_spots(path)[shot.waypoint], atol=1e-9)
        assert shot.dwell_s == pytest.approx(DWELL_S)


def test_a_shot_shorter_than_a_step_is_seen_to_shine(arm):
    arm.stage(zigzag(laser_on=np.arange(COUNT) % 2 == 0), SCAN_NS, SCAN_POSE)  # every one alone: a halt and a burst
    arm.execute(SCAN_NS, DWELL_S)
    seen = 0
    while arm.state == "executing":
        before_s, shots = arm.elapsed_s, arm.step(10 * DWELL_S)
        assert all(before_s < shot.start_s + shot.dwell_s <= arm.elapsed_s for shot in shots)
        assert arm.shone or not shots
        seen += bool(shots) and not arm.laser_on
    assert seen > 0
    assert not arm.shone


def test_a_stray_arm_misses_by_as_much():
    stray = np.eye(4)
    stray[:3, 3] = 0.0, 20e-6, 0.0
    arm = Arm(ArmConfig(), LASER2EE, SCAN_POSE, stray=lambda: stray)
    path = zigzag()
    shots = run(arm, path)
    inner = np.flatnonzero(~np.isin(np.arange(COUNT) % POINTS, (0, POINTS - 1)))
    off = np.array([shots[i].focus2base[:3, 3] for i in inner]) - expected_spots(path)[inner]
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 20e-6, atol=2e-7)


def test_after_an_abort_the_arm_can_be_sent_back(arm):
    arm.stage(zigzag(), SCAN_NS, SCAN_POSE)
    arm.execute(SCAN_NS, DWELL_S)
    while arm.executed < 7:
        arm.step(1e-3)
    arm.abort()
    assert arm.go_to(SCAN_POSE, SCAN_NS) > 0
    with pytest.raises(ExecutionError, match="at rest"):
        arm.go_to(SCAN_POSE, SCAN_NS)
    with pytest.raises(ExecutionError, match="at rest"):
        arm.stage(zigzag(), SCAN_NS, SCAN_POSE)
    while arm.state == "returning":
        assert arm.step(1e-3) == []
        assert not arm.laser_on
    assert arm.state == "idle"
    np.testing.assert_allclose(arm.ee2base, SCAN_POSE, atol=1e-12)


def test_history_is_bounded(arm, monkeypatch):
    monkeypatch.setattr("octn_ros.simulation.arm.HISTORY_LENGTH", 5)
    arm = Arm(ArmConfig(), LASER2EE, SCAN_POSE)
    run(arm, zigzag(), 1e-3)
    assert len(arm.history) == 5


def test_staging_moves_nothing(arm):
    arm.stage(zigzag(), SCAN_NS, SCAN_POSE)
    assert arm.step() == []
    np.testing.assert_allclose(arm.ee2base, SCAN_POSE)
    assert (arm.state, arm.executed, arm.progress) == ("staged", 0, (0, COUNT))


def test_the_target_puts_the_laser_frame_on_the_waypoint(arm):
    path = zigzag()
    arm.stage(path, SCAN_NS, SCAN_POSE)
    arm.execute(SCAN_NS, DWELL_S)
    while arm.progress[0] == 0:
        arm.step(1e-5)
    expected = SCAN_POSE @ path.waypoints_ee[0] @ np.linalg.inv(LASER2EE)
    np.testing.assert_allclose(arm.ee2base[:3, 3], expected[:3, 3], atol=3e-6)


@pytest.mark.parametrize(
    ("changes", "scan_ns", "pose", "message"),
    [
        ({"frame": "base_link"}, SCAN_NS, SCAN_POSE, "in frame 'tool0', got frame 'base_link'"),
        ({"stamp_ns": 5}, SCAN_NS, SCAN_POSE, r"present scan \(stamp 1000000000 ns\), got one of another scan"),
        ({}, SCAN_NS + 1, SCAN_POSE, "another scan"),
        ({}, SCAN_NS, np.diag([2.0, 1, 1, 1]), "scan_ee2base: expected finite rigid"),
        ({}, SCAN_NS, posed(0.9, 0, 0, 0, 0, 0), "within the reach of 0.85 m, got 0.900 m at waypoint 0 of 15"),
    ],
)
def test_plans_that_do_not_fit_are_refused(arm, changes, scan_ns, pose, message):
    arm.stage(zigzag(), SCAN_NS, SCAN_POSE)
    with pytest.raises(ExecutionError, match=message):
        arm.stage(zigzag(**changes), scan_ns, pose)
    assert arm.state == "idle", "a refused plan leaves none behind"


def test_an_empty_plan_is_refused(arm):
    empty = LaserPath(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0), np.zeros(0), SCAN_NS, "tool0")
    with pytest.raises(ExecutionError, match="got an empty plan"):
        arm.stage(empty, SCAN_NS, SCAN_POSE)


def test_execute_needs_a_plan_and_takes_it_once(arm):
    with pytest.raises(ExecutionError, match=r"expected a staged plan, got none \(the arm is idle\)"):
        arm.execute(SCAN_NS, DWELL_S)
    run(arm, zigzag())
    with pytest.raises(ExecutionError, match="the arm is done"):
        arm.execute(SCAN_NS, DWELL_S)
    run(arm, zigzag())
    assert arm.executed == COUNT


def test_an_abort_in_mid_raster_turns_the_laser_off_at_once_and_cuts_the_shot_short():
    for elapsed_s in np.arange(0.15, 0.2, 3e-4):
        arm = Arm(ArmConfig(), LASER2EE, SCAN_POSE)
        arm.stage(zigzag(), SCAN_NS, SCAN_POSE)
        arm.execute(SCAN_NS, DWELL_S)
        arm.step(elapsed_s)
        cut = arm.abort()
        if cut:
            break
    (shot,) = cut
    assert 0.0 < shot.dwell_s < DWELL_S
    assert shot.start_s + shot.dwell_s == pytest.approx(arm.elapsed_s)
    assert (arm.state, arm.laser_on, arm.history[-1].laser_on) == ("aborted", False, False)
    pose, shots = arm.ee2base.copy(), arm.executed
    assert arm.step() == []
    np.testing.assert_array_equal(arm.ee2base, pose)
    assert arm.executed == shots
    with pytest.raises(ExecutionError, match="the arm is aborted"):
        arm.execute(SCAN_NS, DWELL_S)


def test_stopping_without_a_plan_changes_nothing(arm):
    assert arm.abort() == []
    arm.withdraw()
    assert arm.state == "idle"


def test_a_running_arm_takes_no_other_plan(arm):
    arm.stage(zigzag(), SCAN_NS, SCAN_POSE)
    arm.execute(SCAN_NS, DWELL_S)
    with pytest.raises(ExecutionError, match="abort first"):
        arm.stage(zigzag(), SCAN_NS, SCAN_POSE)
    assert arm.state == "executing"


@pytest.mark.parametrize("dt_s", [-1.0, np.nan, np.inf])
def test_impossible_steps_are_refused(arm, dt_s):
    with pytest.raises(ExecutionError, match="at least 0 s"):
        arm.step(dt_s)


def test_transforms_and_limits_are_checked():
    with pytest.raises(ExecutionError, match="laser2ee: expected finite rigid"):
        Arm(ArmConfig(), np.diag([1.0, 1, -1, 1]), SCAN_POSE)
    with pytest.raises(ExecutionError, match="ee2base: expected poses of shape"):
        Arm(ArmConfig(), LASER2EE, np.eye(3))
    with pytest.raises(ConfigurationError, match="max_speed_m_s"):
        ArmConfig(max_speed_m_s=0.0)


def test_ten_thousand_waypoints_are_quick(arm):
    count = 10_000
    poses = np.tile(LASER2EE, (count, 1, 1))
    poses[:, 0, 3] += np.linspace(0, 3e-3, count)
    path = LaserPath(poses, np.zeros(count), np.ones(count), np.full(count, 0.1), SCAN_NS, "tool0")
    run(arm, path, 0.05)
    assert arm.executed == count
