import math

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import (
    Conditions,
    Inaccuracy,
    InaccuracyConfig,
    InterlockConfig,
    TissueMotion,
    TissueMotionConfig,
    why_off,
)

GOOD = {"enabled": True, "plan_age_s": 5.0, "unvouched": None, "tissue_moved_m": 50e-6, "stalled_s": 0.2}


def test_with_every_condition_held_the_laser_may_be_on():
    assert why_off(InterlockConfig(), Conditions(**GOOD)) is None


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"enabled": False}, "call enable_laser first"),
        ({"plan_age_s": 601.0}, "0 to 600 s old, got one of 601.0 s"),
        ({"plan_age_s": -0.1}, "got one of -0.1 s"),
        ({"plan_age_s": math.nan}, "got one of nan s"),
        ({"unvouched": "expected a planner"}, "expected a planner"),
        ({"tissue_moved_m": 120e-6}, "within 100 um of its place at the scan, got it 120 um away"),
        ({"tissue_moved_m": math.nan}, "nan um away"),
        ({"stalled_s": 0.6}, "every 0.5 s at least while the shutter is open, got none for 0.60 s"),
        ({"stalled_s": math.nan}, "none for nan s"),
        ({"stalled_s": -0.1}, "clock that goes on, got one set back by 0.10 s"),
    ],
)
def test_each_condition_alone_turns_it_off(changes, reason):
    assert reason in why_off(InterlockConfig(), Conditions(**{**GOOD, **changes}))


def test_tissue_need_not_be_watched():
    assert why_off(InterlockConfig(max_tissue_motion_m=0.0), Conditions(**{**GOOD, "tissue_moved_m": 1.0})) is None


@pytest.mark.parametrize("silence_s", [1.5, 2.0])
def test_a_planner_may_be_silent_for_longer_than_the_simulator_may_be_deaf(silence_s):
    assert InterlockConfig(planner_silence_s=silence_s, longest_stall_s=0.4).planner_silence_s == silence_s
    with pytest.raises(ConfigurationError, match=f"above {1.0 + silence_s - 1.0:g} s.*got {silence_s:g} s"):
        InterlockConfig(planner_silence_s=silence_s, longest_stall_s=silence_s - 1.0)


def test_tissue_jumps_drifts_and_goes_on_from_there():
    motion = TissueMotion(TissueMotionConfig(tracker_noise_m=0.0), 10.0)
    np.testing.assert_array_equal(motion.place_m(20.0), 0.0)
    drifting = TissueMotionConfig(shift_m=(1e-3, 0.0, 0.0), drift_m_s=(0.0, 1e-5, 0.0), tracker_noise_m=0.0)
    motion.change(drifting, 20.0)
    motion.change(drifting, 25.0)
    np.testing.assert_allclose(motion.place_m(30.0), [1e-3, 1e-4, 0.0])
    motion.change(TissueMotionConfig(tracker_noise_m=0.0), 30.0)
    np.testing.assert_allclose(motion.measured_m(99.0), [0.0, 1e-4, 0.0], atol=1e-15)


def test_the_tracker_sees_it_with_its_noise():
    motion = TissueMotion(TissueMotionConfig(tracker_noise_m=5e-6), 0.0, seed=3)
    seen = np.array([motion.measured_m(1.0) for _ in range(2000)])
    assert seen.std() == pytest.approx(5e-6, rel=0.05)
    assert abs(seen.mean()) < 5e-7


def test_errors_have_the_size_asked_for_and_a_seed():
    config = InaccuracyConfig(calibration_error_m=30e-6, calibration_error_deg=0.2, pose_noise_m=10e-6, seed=4)
    first, again = Inaccuracy(config), Inaccuracy(config)
    np.testing.assert_array_equal(first.oct2oct, again.oct2oct)
    assert np.linalg.norm(first.oct2oct[:3, 3]) == pytest.approx(30e-6)
    turn = np.degrees(np.arccos((np.trace(first.oct2oct[:3, :3]) - 1) / 2))
    assert turn == pytest.approx(0.2, rel=1e-4)
    assert not np.allclose(Inaccuracy(InaccuracyConfig(calibration_error_m=30e-6, seed=5)).oct2oct, first.oct2oct)
    strays = np.array([first.stray() for _ in range(2000)])
    np.testing.assert_array_equal(strays[:10], [again.stray() for _ in range(10)])
    assert strays[:, :3, 3].std() == pytest.approx(10e-6, rel=0.05)
    np.testing.assert_array_equal(strays[:, :3, :3], np.broadcast_to(np.eye(3), (2000, 3, 3)))
    np.testing.assert_array_equal(Inaccuracy(InaccuracyConfig()).stray(), np.eye(4))
    np.testing.assert_array_equal(Inaccuracy(InaccuracyConfig()).oct2oct, np.eye(4))
