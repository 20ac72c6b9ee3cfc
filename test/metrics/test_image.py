import math

import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.metrics import psnr_db


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
