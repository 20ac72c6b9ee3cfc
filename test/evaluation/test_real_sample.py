"""A real scan, where nothing is known but what was measured: more time makes a field more faithful to it."""

import dataclasses
import os
from pathlib import Path

import pytest

from octn_ros.evaluation import compare_on_grid
from octn_ros.training import PRESETS, fit
from octn_ros.volume import load_volume

SAMPLE = (
    Path(os.environ.get("OCTN_SHARED", Path(__file__).parents[3] / "shared"))
    / "data"
    / "granular_sample_sdoct_rawfft.nii.gz"
)
SPACING_UM = (20.0, 5.0, 20.0)


@pytest.mark.slow
@pytest.mark.skipif(not SAMPLE.exists(), reason=f"no {SAMPLE}: set OCTN_SHARED to the folder that has data/")
def test_psnr_rises_with_the_time_budget_doubled():
    volume = load_volume(SAMPLE, SPACING_UM)

    def psnr_db(seconds):
        config = dataclasses.replace(PRESETS["fast"], time_budget_s=seconds)
        return compare_on_grid(fit(volume, config, device="cpu").field, [volume])[0].psnr_db

    psnr_db(0.5)  # a machine's first fit compiles
    short, long = psnr_db(5.0), psnr_db(10.0)
    assert short > 20.0
    assert long > short
