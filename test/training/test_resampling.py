"""A-scans read between their voxels: exact where the cubic is, held at the ends, the same compiled or not."""

import numpy as np
import pytest

from octn_ros.training.resampling import flattened, resampled, resampled_reference, sharpened


def random_planes(bscans=3, axials=30, laterals=11):
    return np.float32(np.random.default_rng(0).random((bscans, axials, laterals)))


def test_the_compiled_way_equals_the_plain_one():
    """Also far beyond both ends."""
    planes = random_planes()
    rows = np.linspace(-50.0, 80.0, 77, dtype=np.float32)
    shift = np.float32(np.random.default_rng(1).normal(0.0, 5.0, (3, 11)))
    np.testing.assert_allclose(resampled(planes, rows, shift), resampled_reference(planes, rows, shift), atol=1e-6)


def test_without_numba_it_is_the_plain_one(monkeypatch):
    """Nobody needs a compiler."""
    monkeypatch.setattr("octn_ros.training.resampling.numba_is_there", lambda: False)
    planes, rows, shift = random_planes(), np.arange(30, dtype=np.float32), np.full((3, 11), 0.3)
    expected = resampled_reference(planes, rows, np.float32(shift))
    np.testing.assert_array_equal(resampled(planes, rows, shift), expected)


def test_voxels_are_given_back_and_parabolas_are_met_between_them():
    """Catmull and Rom's cubic passes through the voxels and is exact for second degree."""
    planes = random_planes()
    whole = np.arange(30, dtype=np.float32)
    np.testing.assert_array_equal(resampled(planes, whole, np.zeros((3, 11))), planes)
    parabola = np.float32(0.002 * np.arange(30.0) ** 2)[None, :, None]
    rows = np.arange(2, 25, dtype=np.float32)
    shifted = resampled(np.repeat(parabola, 4, axis=2), rows, np.array([[0.0, 0.25, 0.5, 0.9]]))
    expected = 0.002 * (rows[:, None] + np.array([0.0, 0.25, 0.5, 0.9])) ** 2
    np.testing.assert_allclose(shifted[0], expected, rtol=1e-5)


def test_beyond_their_ends_ascans_are_held():
    """As far as anyone asks."""
    planes = random_planes()
    answer = resampled(planes, np.array([-9.0, 99.0], np.float32), np.zeros((3, 11)))
    np.testing.assert_array_equal(answer, planes[:, [0, -1]])


def test_a_slope_that_is_flattened_is_flat():
    """Every A-scan's sheet lies in one row, and nothing of an A-scan is cut off."""
    depth = np.linspace(3.0, 12.0, 7)[None, :]
    planes = np.float32(np.tanh(0.5 * (np.arange(40)[None, :, None] - 15.0 - depth[:, None, :])))
    flat, top = flattened(planes, depth)
    assert (flat.shape, top) == ((1, 52, 7), 12)
    expected = np.tanh(0.5 * (np.arange(-top, 40) - 15.0))
    # Where an A-scan goes on; below it is held. The cubic is not quite a tanh.
    np.testing.assert_allclose(flat[0, :-14], np.repeat(expected[:-14, None], 7, axis=1), atol=0.015)
    kept = resampled(flat, np.arange(40, dtype=np.float32) + top, -depth)
    np.testing.assert_allclose(kept[:, :26], planes[:, :26], atol=0.015)


@pytest.mark.parametrize("variance", [0.25, 0.5])
def test_what_is_sharpened_comes_out_whole_of_a_blur(variance):
    """To second order: what is left of a slow wave's loss is a small part of it."""
    wave = np.float32(np.sin(0.4 * np.arange(60)))[None, :, None]
    blur = np.array([0.5 * variance, 1.0 - variance, 0.5 * variance])

    def blurred(plane):
        return np.convolve(plane[0, :, 0], blur, mode="valid")

    inside = wave[0, 1:-1, 0]
    lost = np.abs(blurred(wave) - inside)[5:-5].max()
    assert np.abs(blurred(sharpened(wave, variance)) - inside)[5:-5].max() < 0.1 * lost
