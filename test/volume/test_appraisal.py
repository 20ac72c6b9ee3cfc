"""What `octn info` estimates, on scans whose surface and noise are known."""

import math

import numpy as np
import pytest

from octn_ros.volume import Volume
from octn_ros.volume.appraisal import appraise, histogram

SPACING_M = (28e-6, 14e-6, 14e-6)


def step(contrast=0.4, noise=0.02, shape=(80, 64, 40), tilt=0.2):
    """A half space of constant brightness under a tilted plane, and Gaussian noise on all of it."""
    _, axial, lateral = np.indices(shape, dtype=np.float32)
    surface = 20.0 + tilt * lateral
    scan = 0.2 + contrast * np.clip(axial - surface + 0.5, 0, 1)
    return (scan + noise * np.random.default_rng(1).standard_normal(shape)).astype(np.float32)


def test_surface_rows_are_those_of_the_plane():
    found = appraise(Volume.from_array(step(), SPACING_M, intensity_range=(0, 1)))
    assert found.surface_row == pytest.approx(20.0 + 0.2 * 19.5, abs=0.6)
    assert found.surface_row_range == pytest.approx((20.0 + 0.2 * 2, 20.0 + 0.2 * 37), abs=1.0)


@pytest.mark.parametrize(("contrast", "noise"), [(0.4, 0.02), (0.4, 0.04), (0.2, 0.01)])
def test_snr_is_contrast_over_noise_of_the_air(contrast, noise):
    found = appraise(Volume.from_array(step(contrast, noise), SPACING_M, intensity_range=(0, 1)))
    assert found.snr_db == pytest.approx(20 * math.log10(contrast / noise), abs=0.3)


def test_without_air_there_is_no_snr():
    found = appraise(Volume.from_array(step()[:, 24:], SPACING_M, intensity_range=(0, 1)))
    assert math.isnan(found.snr_db)


def test_every_voxel_is_in_the_histogram_once():
    scan = np.random.default_rng(2).integers(3, 240, (5, 6, 7)).astype(np.uint8)
    counts, edges = histogram(Volume.from_array(scan, SPACING_M), 10)
    assert counts.sum() == scan.size
    assert (edges[0], edges[-1], len(edges)) == (scan.min(), scan.max(), 11)
    np.testing.assert_array_equal(counts, np.histogram(scan, 10)[0])
