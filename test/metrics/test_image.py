import math

import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.metrics import psnr_db, psnr_from_error_db, ssim


def test_psnr_by_hand():
    reference = np.zeros((4, 5, 6), dtype=np.float32)
    assert psnr_db(reference, reference + 0.1) == pytest.approx(20.0, abs=1e-4)
    # One wrong voxel of 1/2 among 120: mean squared error 1/480.
    other = reference.copy()
    other[1, 2, 3] = 0.5
    assert psnr_db(reference, other) == pytest.approx(10 * math.log10(480))


def test_psnr_uses_the_data_range_and_does_not_wrap_integers():
    reference, test = np.array([0, 255], dtype=np.uint8), np.array([1, 254], dtype=np.uint8)
    assert psnr_db(reference, test, data_range=255.0) == pytest.approx(20 * math.log10(255))


def test_equal_images_are_infinitely_close():
    assert psnr_db(np.ones(3), np.ones(3)) == math.inf


@pytest.mark.parametrize(
    ("reference", "test", "data_range"),
    [
        (np.ones(3), np.ones(4), 1.0),
        (np.ones(0), np.ones(0), 1.0),
        (np.ones(3), np.ones(3), 0.0),
        (np.ones(3), np.ones(3), float("nan")),
    ],
)
def test_psnr_refuses_what_it_cannot_compare(reference, test, data_range):
    with pytest.raises(QueryError, match="psnr_db: expected"):
        psnr_db(reference, test, data_range)


def test_psnr_of_a_mean_squared_error():
    assert psnr_from_error_db(1e-3) == pytest.approx(30.0)
    assert psnr_from_error_db(0.0) == math.inf
    assert math.isnan(psnr_from_error_db(math.inf))
    assert math.isnan(psnr_from_error_db(math.nan))


def test_ssim_of_a_constant_shift_by_hand():
    # Two constant images of 0.5 and 0.7 have no variance: the contrast term is C2 / C2 = 1, and what is left is
    # (2 * 0.5 * 0.7 + C1) / (0.5^2 + 0.7^2 + C1) with C1 = (0.01 * 1)^2 = 1e-4: 0.7001 / 0.7401.
    one, other = np.full((16, 16), 0.5), np.full((16, 16), 0.7)
    assert ssim(one, other) == pytest.approx(0.7001 / 0.7401)
    # With a data range of 10, C1 = 1e-2: 0.71 / 0.75.
    assert ssim(one, other, data_range=10.0) == pytest.approx(0.71 / 0.75)


def test_ssim_of_an_inverted_pattern_by_hand():
    # Columns alternate 0, 1; the other image is the inverse. Mean 1/2 and variance 1/4 in every window (to the window's
    # tails), covariance -1/4: luminance 1, contrast and structure (-1/2 + C2) / (1/2 + C2) with C2 = 9e-4.
    pattern = np.tile([0.0, 1.0], (32, 16))
    assert ssim(pattern, 1.0 - pattern) == pytest.approx((-0.5 + 9e-4) / (0.5 + 9e-4), abs=1e-3)


def test_ssim_is_symmetric_and_one_for_equal_images():
    generator = np.random.default_rng(0)
    one, other = generator.random((20, 24)), generator.random((20, 24))
    assert ssim(one, other) == pytest.approx(ssim(other, one))
    assert ssim(one, one) == pytest.approx(1.0)
    assert ssim(one, other) < 0.3


@pytest.mark.parametrize(
    ("reference", "test", "data_range"),
    [
        (np.ones((16, 16)), np.ones((16, 17)), 1.0),
        (np.ones((10, 16)), np.ones((10, 16)), 1.0),
        (np.ones((4, 16, 16)), np.ones((4, 16, 16)), 1.0),
        (np.ones((16, 16)), np.ones((16, 16)), -1.0),
    ],
)
def test_ssim_refuses_what_it_cannot_compare(reference, test, data_range):
    with pytest.raises(QueryError, match="ssim: expected"):
        ssim(reference, test, data_range)
