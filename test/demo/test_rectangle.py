"""The default rectangle: centred, at most 3 x 3 mm, inside the scan at any angle."""

import math

import numpy as np
import pytest

from octn_ros.demo.rectangle import centred_rectangle
from octn_ros.errors import PlanError
from octn_ros.planning import rectangle_corners
from octn_ros.volume import VolumeGeometry


def test_a_large_scan_gets_three_by_three_millimetres():
    geometry = VolumeGeometry((128, 160, 256), (28e-6, 14.59e-6, 14e-6), (1e-3, -2e-3, 0.0))
    corner, opposite = centred_rectangle(geometry)
    assert np.subtract(opposite, corner) == pytest.approx((3e-3, 3e-3))
    assert np.add(opposite, corner) / 2 == pytest.approx((1e-3 + 255 * 7e-6, -2e-3 + 127 * 14e-6))


def test_a_small_scan_gets_what_fits_with_a_margin():
    corner, opposite = centred_rectangle(VolumeGeometry((11, 9, 21), (20e-6, 5e-6, 10e-6)))
    assert corner == pytest.approx((20e-6, 40e-6))
    assert opposite == pytest.approx((180e-6, 160e-6))


@pytest.mark.parametrize("degrees", [-170, -90, -45, 10, 45, 60, 90, 135, 180])
@pytest.mark.parametrize("shape", [(40, 9, 120), (120, 9, 40), (300, 9, 300)])
def test_a_turned_rectangle_stays_inside_and_has_two_sides(degrees, shape):
    geometry = VolumeGeometry(shape, (20e-6, 5e-6, 20e-6))
    angle = math.radians(degrees)
    corners = rectangle_corners(*centred_rectangle(geometry, angle), angle)
    width, length, _ = geometry.extent_m
    assert (corners > 0).all()
    assert (corners < (width, length)).all()
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    assert sides.min() > 0.2e-3
    assert sides.max() < 3e-3 + 1e-9


def test_no_room_and_no_angle_are_errors():
    with pytest.raises(PlanError, match="got 5 and 40"):
        centred_rectangle(VolumeGeometry((5, 9, 40), (20e-6, 5e-6, 20e-6)))
    with pytest.raises(PlanError, match="finite angle"):
        centred_rectangle(VolumeGeometry((50, 9, 40), (20e-6, 5e-6, 20e-6)), math.nan)
