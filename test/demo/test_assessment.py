"""The figures that the demo works out itself."""

import numpy as np
import pytest

from octn_ros.demo.assessment import evenly_spaced, render_bscans
from octn_ros.field import InterpolatedField
from octn_ros.volume import Volume


def test_b_scans_are_evenly_spaced_with_both_ends():
    assert evenly_spaced(128).tolist() == [0, 8, 17, 25, 34, 42, 51, 59, 68, 76, 85, 93, 102, 110, 119, 127]
    assert evenly_spaced(5).tolist() == [0, 1, 2, 3, 4]


def test_rendered_b_scans_are_those_of_the_volume():
    array = np.random.default_rng(0).random((9, 7, 5), dtype=np.float32)
    volume = Volume.from_array(array, (20e-6, 5e-6, 10e-6), intensity_range=(0.0, 1.0))
    chosen = evenly_spaced(9, 4)
    assert render_bscans(InterpolatedField(volume), chosen) == pytest.approx(array[chosen], abs=1e-5)
