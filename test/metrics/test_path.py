import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octn_ros.errors import PlanError
from octn_ros.metrics import hit_rate, smoothness_energy_mm2


def test_hit_rate_counts_given_up_points_as_misses():
    intensity = np.array([0.4, 0.42, 0.4201, 0.38, 0.3799, np.nan, 0.4])
    given_up = np.array([False, False, False, False, False, True, True])
    assert hit_rate(intensity, 0.4, given_up, tolerance=0.05 + 1e-9) == pytest.approx(3 / 7)


def test_smoothness_by_hand():
    # 0.1 - 2 * 0.2 + 0 in the first line, 9.3 - 2 * 9 + 9 in the second; the turn between them does not count.
    depth_m = np.array([0.0, 0.2, 0.1, 9.0, 9.0, 9.3]) * 1e-3
    segment = np.array([0, 0, 0, 1, 1, 1])
    assert smoothness_energy_mm2(depth_m, segment) == pytest.approx((0.1 - 0.4 + 0.0) ** 2 + 0.3**2)


@given(st.floats(-1e-3, 1e-3), st.floats(-1e-4, 1e-4), st.integers(1, 40))
def test_a_straight_line_is_perfectly_smooth(start, slope, count):
    depth = start + slope * np.arange(count)
    assert smoothness_energy_mm2(depth, np.zeros(count, dtype=np.int32)) == pytest.approx(0.0, abs=1e-15)


def test_short_segments_have_no_interior():
    assert smoothness_energy_mm2(np.array([1.0, 5.0, 2.0, 7.0]), np.array([0, 0, 1, 1])) == 0.0


def test_wrong_shapes_and_tau():
    with pytest.raises(PlanError, match=r"two filled arrays \[N\]"):
        hit_rate(np.ones(3), 0.4, np.zeros(2, dtype=bool))
    with pytest.raises(PlanError, match="two filled arrays"):
        hit_rate(np.ones(0), 0.4, np.zeros(0, dtype=bool))
    with pytest.raises(PlanError, match="positive tau, got nan"):
        hit_rate(np.ones(3), float("nan"), np.zeros(3, dtype=bool))
    with pytest.raises(PlanError, match=r"two arrays \[N\]"):
        smoothness_energy_mm2(np.ones(3), np.zeros(2))
