"""The noise of a C-scan, estimated from itself, and the fit that stops at it."""

import dataclasses

import numpy as np
import pytest
import torch

from octn_ros.errors import TrainingError
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.metrics import psnr_db
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.training import FitConfig, ResidentVoxels, fit
from octn_ros.training.noise import noise_variance
from octn_ros.volume import Volume

SPACING_M = (28e-6, 14.59e-6, 14e-6)
CPU = torch.device("cpu")


def variance_of(array):
    return noise_variance(ResidentVoxels(Volume.from_array(array, SPACING_M), CPU))


def test_noise_on_a_ramp_is_found_exactly_enough():
    generator = np.random.default_rng(0)
    ramp = 0.3 + 0.01 * np.indices((12, 40, 40))[0]
    for sigma in (0.01, 0.1):
        noisy = ramp + sigma * generator.standard_normal(ramp.shape)
        assert variance_of(noisy.clip(0, 1)) == pytest.approx(sigma**2, rel=0.05)
    assert variance_of(ramp + 0.001 * np.indices(ramp.shape)[1]) < 1e-9


@pytest.mark.parametrize("speckle", ["single-look", "averaged"])
def test_noise_of_a_phantom_is_its_distance_from_its_truth(speckle):
    phantom = make_phantom(PhantomConfig(shape=(24, 64, 64), speckle=speckle))
    true = float(np.mean((phantom.volume.normalized() - phantom.truth.normalized()) ** 2))
    assert noise_variance(ResidentVoxels(phantom.volume, CPU)) == pytest.approx(true, rel=0.05)


def test_two_bscans_tell_no_noise():
    with pytest.raises(TrainingError, match="at least 3 B-scans"):
        variance_of(np.random.default_rng(0).random((2, 8, 8)))


def test_a_fit_that_stops_at_the_noise_is_nearer_to_the_truth():
    phantom = make_phantom(PhantomConfig(shape=(24, 64, 64), speckle="single-look", snr_db=8.0))
    shape = NeuralFieldConfig(HashGridConfig(8, 2, 14, 8), NetworkConfig(1, 32))
    config = FitConfig(preset="test", field=shape, steps=160, batch=4096)
    stopped = fit(phantom.volume, dataclasses.replace(config, stop_at_noise=True))
    whole = fit(phantom.volume, config)
    assert (stopped.ended, whole.ended) == ("noise level", "steps")
    assert stopped.steps < whole.steps
    assert whole.psnr_db > stopped.psnr_db, "against the measurement the longer fit is the closer one"
    truth = phantom.truth.normalized()
    assert psnr_db(truth, rendered(stopped.field)) > psnr_db(truth, rendered(whole.field)) + 1.5


def rendered(field):
    bscan, axial, lateral = (torch.linspace(-1, 1, n) for n in field.geometry.shape)
    return field.lattice(lateral, axial, bscan).numpy()
