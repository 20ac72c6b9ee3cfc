import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.metrics import snr_db
from octn_ros.simulation import PhantomConfig, make_phantom, region_snr

VOXEL_M = 14.59e-6


@pytest.mark.parametrize("speckle", ["single-look", "averaged"])
@pytest.mark.parametrize("configured_db", [8.0, 13.0, 15.0, 18.0])
def test_measured_regions_show_the_snr_that_is_foretold(speckle, configured_db):
    config = PhantomConfig(
        shape=(48, 72, 64), surface="flat", surface_depth_m=30 * VOXEL_M, asymmetric=False, snr_db=configured_db,
        speckle=speckle,
    )  # fmt: skip
    shown = make_phantom(config).volume.normalized()
    # Rows 3 to 8 below the surface, each standing for half a voxel to both sides.
    tissue, air = shown[:, 33:39], shown[:, :26]
    expected = region_snr(config, 2.5 * VOXEL_M, 8.5 * VOXEL_M)
    power = [10.0 ** (config.dynamic_range_db / 10.0 * part.astype(np.float64)) for part in (tissue, air)]
    # Displayed air is clipped to black now and then in single-look speckle, which lifts its mean power a little.
    assert 10.0 * np.log10(power[0].mean() / power[1].mean()) == pytest.approx(expected.power_db, abs=0.1)
    assert snr_db(tissue, air) == pytest.approx(expected.displayed_db, abs=0.1)


def test_power_snr_is_the_configured_one_at_the_surface_and_without_attenuation():
    clear = PhantomConfig(snr_db=13.0, attenuation_per_m=0.0)
    assert region_snr(clear, 40e-6, 150e-6).power_db == pytest.approx(13.0, abs=1e-3)
    muddy = PhantomConfig(snr_db=13.0, attenuation_per_m=3000.0)
    shallow, deep = (region_snr(muddy, start, start + 20e-6).power_db for start in (30e-6, 150e-6))
    assert deep < shallow < 13.0
    loss = 10.0 * np.log10(1.0 + (10**1.3 - 1.0) * np.exp(-2 * 3000.0 * 40e-6))
    assert shallow == pytest.approx(loss, abs=0.05)


def test_displayed_snr_of_single_look_speckle_is_in_the_papers_range():
    shown = [region_snr(PhantomConfig(snr_db=snr, speckle="single-look")).displayed_db for snr in (13.0, 15.0, 18.0)]
    assert 12.5 < min(shown) < max(shown) < 18.0


@pytest.mark.parametrize("depths", [(-1e-6, 1e-4), (1e-4, 1e-4), (2e-4, 1e-4)])
def test_depths_in_disorder_are_refused(depths):
    with pytest.raises(ConfigurationError, match="0 <= start_m < end_m"):
        region_snr(PhantomConfig(), *depths)
