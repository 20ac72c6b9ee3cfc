import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import LaserConfig

DWELL_S = 5e-3


def test_the_crater_is_the_super_gaussian_of_the_platform():
    laser = LaserConfig(order=2.0, sigma_m=60e-6)
    dx, dy = 30e-6, -50e-6
    middle = float(laser.crater_m(0.0, DWELL_S))
    expected = middle * math.exp(-(((dx**2 + dy**2) / (2 * 60e-6**2)) ** 2.0))
    assert float(laser.crater_m(dx**2 + dy**2, DWELL_S)) == pytest.approx(expected)
    assert float(laser.crater_m(laser.spot_radius_m**2, DWELL_S)) == pytest.approx(middle / math.e)


@given(st.floats(0.6, 8.0), st.floats(20e-6, 200e-6), st.floats(0.0, 5e-3))
def test_its_volume_is_the_energy_over_the_heat_of_ablation_whatever_its_form(order, sigma_m, defocus_m):
    laser = LaserConfig(order=order, sigma_m=sigma_m)
    r = np.linspace(0.0, laser.reach_m(defocus_m), 20_001)
    volume = np.trapezoid(2 * np.pi * r * laser.crater_m(r**2, DWELL_S, defocus_m), r)
    energy = 2.0 * 0.2 * DWELL_S
    assert volume == pytest.approx(energy / laser.heat_of_ablation_j_per_m3, rel=2e-3)


def test_depth_follows_dwell_power_and_duty_cycle_beyond_the_threshold():
    laser = LaserConfig(threshold_j=1e-3)
    assert laser.removed_volume_m3([0.0, 2.5e-3]) == pytest.approx([0.0, 0.0])
    assert laser.removed_volume_m3(7.5e-3) == pytest.approx(2 * laser.removed_volume_m3(5e-3))
    strong = LaserConfig(power_w=4.0, duty_cycle=0.3)
    assert strong.removed_volume_m3(DWELL_S) == pytest.approx(3 * LaserConfig().removed_volume_m3(DWELL_S))
    assert laser.raster_depth_m(laser.dwell_for(80e-6, 75e-6, 50e-6), 75e-6, 50e-6) == pytest.approx(80e-6)


def test_out_of_focus_the_crater_is_wider_and_shallower():
    laser = LaserConfig()
    far = laser.rayleigh_range_m
    assert laser.width(far) == pytest.approx(math.sqrt(2) * laser.sigma_m)
    assert float(laser.crater_m(0.0, DWELL_S, far)) == pytest.approx(0.5 * float(laser.crater_m(0.0, DWELL_S)))


def test_impossible_lasers_are_refused():
    for wrong in ({"duty_cycle": 1.1}, {"sigma_m": 0.0}, {"power_w": -1.0}, {"order": 0.1}):
        with pytest.raises(ConfigurationError, match=next(iter(wrong))):
            LaserConfig(**wrong)
