"""Intensity and gradient at points: exact for a field that is linear, NaN outside."""

from __future__ import annotations

import numpy as np
import pytest

from octn_ros.field import InterpolatedField
from octn_ros.query import evaluate_points, points
from octn_ros.volume import Volume

SPACING_M, ORIGIN_M = (3e-5, 1e-5, 2e-5), (1e-3, -2e-3, 5e-4)
SLOPE_PER_M = np.array([500.0, -300.0, 800.0])  # by (x, y, z)


@pytest.fixture(scope="module")
def linear() -> InterpolatedField:
    """A field whose intensity is 0.5 + slope times the way from the scan's origin."""
    shape = (6, 30, 9)
    y, z, x = (np.arange(count) * step for count, step in zip(shape, SPACING_M, strict=True))
    array = (
        0.5 + SLOPE_PER_M[0] * x[None, None, :] + SLOPE_PER_M[1] * y[:, None, None] + SLOPE_PER_M[2] * z[None, :, None]
    )
    return InterpolatedField(
        Volume.from_array(array.astype(np.float32), SPACING_M, intensity_range=(0.0, 1.0), origin_m=ORIGIN_M)
    )


def test_a_linear_field_has_its_value_and_slope_everywhere(linear: InterpolatedField) -> None:
    inside = np.array(ORIGIN_M) + np.random.default_rng(0).random((200, 3)) * linear.geometry.extent_m
    found = evaluate_points(linear, inside)
    np.testing.assert_allclose(found.intensity, 0.5 + (inside - ORIGIN_M) @ SLOPE_PER_M, atol=1e-5)
    np.testing.assert_allclose(found.gradient_per_m, np.tile(SLOPE_PER_M, (200, 1)), rtol=1e-3)


def test_outside_there_is_nothing_and_the_borders_are_inside(
    linear: InterpolatedField, monkeypatch: pytest.MonkeyPatch
) -> None:
    low, high = np.array(ORIGIN_M), np.array(ORIGIN_M) + linear.geometry.extent_m
    asked = np.array([low, high, low - 1e-6, high + 1e-6, [np.nan, 0, 0], (low + high) / 2, [np.inf, 0, 0]])
    expected = [True, True, False, False, False, True, False]
    for chunk in (1, 2, 1000):
        monkeypatch.setattr(points, "_CHUNK_POINTS", chunk)
        found = evaluate_points(linear, asked)
        assert np.isfinite(found.intensity).tolist() == expected
        assert np.isfinite(found.gradient_per_m).all(axis=1).tolist() == expected


def test_no_points_are_no_answers(linear: InterpolatedField) -> None:
    found = evaluate_points(linear, np.empty((0, 3)))
    assert found.intensity.shape == (0,)
    assert found.gradient_per_m.shape == (0, 3)
