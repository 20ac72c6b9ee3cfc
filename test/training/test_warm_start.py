"""A fit that begins with the field of an earlier scan."""

import dataclasses

import numpy as np
import pytest
import torch

from octn_ros.errors import TrainingError
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.training import FitConfig, fit, psnr_of_field
from octn_ros.volume import Volume

SHAPE = (16, 40, 40)
CONFIG = FitConfig(
    preset="test",
    field=NeuralFieldConfig(
        HashGridConfig(
            levels=3, features=4, log2_table_size=14, base_resolution=8, finest_ratio=0.5, follow_shape=True
        ),
        NetworkConfig(1, 16),
    ),
    steps=150,
    batch=2048,
)


@pytest.fixture(scope="module")
def scans():
    """A phantom and the same one after a super-Gaussian crater, z = A exp(-((dx^2 + dy^2) / (2 sigma^2))^P)."""
    config = PhantomConfig(shape=SHAPE)
    (d, _, w), (bscans, _, laterals) = config.spacing_m, SHAPE
    x, y = np.arange(laterals) * w, np.arange(bscans) * d
    square = (x[None, :] - x.mean()) ** 2 + (y[:, None] - y.mean()) ** 2
    crater_m = 60e-6 * np.exp(-((square / (2 * 60e-6**2)) ** 2))
    return make_phantom(config).volume, make_phantom(config, crater_m).volume


@pytest.fixture(scope="module")
def first(scans):
    return fit(scans[0], CONFIG)


def test_a_warm_start_keeps_what_was_learned(scans, first):
    before = {name: value.clone() for name, value in first.field.model.state_dict().items()}
    short = dataclasses.replace(CONFIG, steps=25)
    warm, cold = fit(scans[1], short, start=first.field), fit(scans[1], short)
    assert warm.psnr_db > psnr_of_field(first.field, scans[1]) + 0.5, "it follows the new scan"
    assert warm.psnr_db > cold.psnr_db + 0.5
    after = first.field.model.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before), "the start field is left as it was"
    assert not any(parameter.requires_grad for parameter in first.field.model.parameters())
    assert warm.field.description.training["warm_start"]
    assert not cold.field.description.training["warm_start"]


def test_a_warm_start_keeps_the_shape_of_its_field(scans, first):
    other = dataclasses.replace(CONFIG, field=NeuralFieldConfig(), steps=2)
    result = fit(scans[1], other, start=first.field)
    assert result.field.config == first.field.config
    assert result.field.description.training["config"]["field"]["grid"]["levels"] == 3


def test_a_target_that_the_start_field_meets_already_ends_the_fit_at_once(scans, first):
    easy = dataclasses.replace(CONFIG, target_psnr_db=first.psnr_db - 4.0)
    result = fit(scans[0], easy, start=first.field)
    assert (result.ended, result.steps) == ("target", 0)
    assert result.psnr_db == pytest.approx(first.psnr_db)


def test_a_field_of_another_geometry_is_refused(scans, first):
    array = scans[0].array
    for other in (
        Volume.from_array(array[:-1], scans[0].geometry.spacing_m),
        Volume.from_array(array, (30e-6, 14.59e-6, 14e-6)),
    ):
        with pytest.raises(TrainingError, match=r"shape .* and spacing"):
            fit(other, CONFIG, start=first.field)


def test_capacity_follows_the_volume_where_it_is_asked_to(scans):
    config = dataclasses.replace(CONFIG, field=dataclasses.replace(CONFIG.field, bits_per_voxel=8.0), steps=2)
    result = fit(scans[0], config)
    assert result.field.config == config.field.for_volume(scans[0].geometry)
    assert result.field.config.bits_per_voxel == 0.0
    assert result.field.description.training["config"]["field"]["grid"]["levels"] == result.field.config.grid.levels
