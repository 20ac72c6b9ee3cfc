"""A start from the data: what the field is before its first step, and that it can learn from there."""

import dataclasses

import numpy as np
import pytest
import torch

from octn_ros.field import FieldDescription, HashGridConfig, NetworkConfig, NeuralField, NeuralFieldConfig, NeuralModel
from octn_ros.metrics import psnr_db
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.training import PRESETS, fit, psnr_of_field
from octn_ros.training.data_start import block_average, start_from_data
from octn_ros.volume import Volume, gaussian_filter

SHAPE = (24, 60, 40)
GRID = HashGridConfig(
    levels=2, features=3, log2_table_size=20, base_resolution=8, finest_ratio=0.5, follow_shape=True, axial_refinement=2
)


def never():
    return False


def model_of(grid=GRID, layers=1, shape=SHAPE):
    torch.manual_seed(0)
    return NeuralModel(NeuralFieldConfig(grid, NetworkConfig(layers, 9)), shape)


def volume_of(intensity):
    return Volume.from_array(np.float32(intensity), (28e-6, 14.59e-6, 14e-6), intensity_range=(0.0, 1.0))


def field_of(model, volume):
    return NeuralField(model, NeuralFieldConfig(), FieldDescription.of_volume(volume, "neural"))


def native(field):
    bscan, axial, lateral = (torch.linspace(-1, 1, n) for n in field.geometry.shape)
    return field.lattice(lateral, axial, bscan).numpy()


@pytest.mark.parametrize("layers", [1, 3])
def test_a_linear_volume_is_reproduced_within(layers):
    """Averages of a plane are the plane, away from the borders, and interpolation keeps it; any depth of network."""
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    volume = volume_of(0.1 + 0.3 * z + 0.2 * y + 0.3 * x)
    model = model_of(layers=layers)
    start_from_data(model, volume, never)
    inside = (slice(4, -4), slice(4, -4), slice(4, -4))
    np.testing.assert_allclose(native(field_of(model, volume))[inside], volume.array[inside], atol=3e-3)


def test_each_vertex_holds_the_mean_that_interpolation_weights():
    """Against the definition, vertex by vertex: sum of weight times voxel over sum of weights."""
    volume = volume_of(np.random.default_rng(0).random((9, 12, 10)))
    level = model_of(shape=(9, 12, 10)).grid.grid_levels[-1]
    average = block_average(volume.normalized, level, volume.geometry, never)
    weights = []
    for count, scale, vertices in zip((10, 12, 9), level.scale, level.vertices, strict=True):
        position = np.linspace(0, 1, count) * scale + 0.5
        weights.append(np.maximum(0, 1 - np.abs(position[None, :] - np.arange(vertices)[:, None])))
    lateral, axial, bscan = weights
    total = np.einsum("zd,yh,xw,dhw->zyx", bscan, axial, lateral, volume.array)
    norm = np.einsum("zd,yh,xw->zyx", bscan, axial, lateral)
    reached = norm > 1e-6
    assert reached.mean() > 0.5
    np.testing.assert_allclose(average[reached], (total[reached] / norm[reached]), rtol=1e-4, atol=1e-5)


def test_cells_finer_than_voxels_are_filled():
    grid = dataclasses.replace(GRID, finest_ratio=3.0, axial_refinement=1.0)
    volume = volume_of(np.broadcast_to(np.linspace(0.2, 0.8, 12)[None, :, None], (9, 12, 10)))
    model = model_of(grid, shape=(9, 12, 10))
    start_from_data(model, volume, never)
    field = field_of(model, volume)
    assert np.isfinite(native(field)).all()
    np.testing.assert_allclose(native(field), volume.array, atol=2e-2)
    middle = field.lattice(torch.zeros(1), torch.linspace(-1, 1, 45), torch.zeros(1)).flatten()
    assert (middle.diff() > -1e-6).all()


def test_the_fit_begins_there_and_improves():
    phantom = make_phantom(PhantomConfig(shape=(24, 80, 48), speckle="single-look", snr_db=13.0))
    config = dataclasses.replace(PRESETS["fast"], batch=4096, steps=40, time_budget_s=0.0, learning_rate=1e-3)
    begun = fit(phantom.volume, dataclasses.replace(config, steps=1, learning_rate=1e-6))
    done = fit(phantom.volume, config)
    assert begun.field.backend == "compiled"
    truth = phantom.truth.normalized()
    gaussian = psnr_db(truth, gaussian_filter(phantom.volume, 1.0).normalized())
    assert psnr_db(truth, native(begun.field)) > gaussian
    assert done.psnr_db > begun.psnr_db
    plain = fit(phantom.volume, dataclasses.replace(config, start_from_data=False, steps=1, learning_rate=1e-6))
    assert begun.psnr_db > plain.psnr_db + 5


def test_levels_that_store_no_vertex_of_their_own_are_passed_over():
    volume = make_phantom(PhantomConfig(shape=(24, 80, 48))).volume
    base = dataclasses.replace(PRESETS["fast"], steps=1, time_budget_s=0.0, learning_rate=1e-6)
    psnr = []
    for log2_table_size in (20, 11, 4):
        grid = dataclasses.replace(GRID, log2_table_size=log2_table_size)
        field = dataclasses.replace(base.field, grid=grid)
        psnr.append(fit(volume, dataclasses.replace(base, field=field)).psnr_db)
    assert psnr[0] > psnr[1] + 1 > psnr[2] + 5


def test_a_warm_start_follows_what_changed():
    config = PhantomConfig(shape=(24, 80, 48))
    crater_m = np.zeros((24, 48))
    crater_m[6:18, 12:36] = 200e-6
    before, after = make_phantom(config), make_phantom(dataclasses.replace(config, seed=1), crater_m)
    short = dataclasses.replace(PRESETS["fast"], batch=4096, steps=60, time_budget_s=0.0)
    first = fit(before.volume, short)
    still = dataclasses.replace(short, steps=1, learning_rate=1e-6)
    warm, anew = fit(after.volume, still, start=first.field), fit(after.volume, still)
    assert warm.psnr_db > psnr_of_field(first.field, after.volume) + 3
    assert warm.psnr_db > anew.psnr_db - 0.01
    same = fit(make_phantom(dataclasses.replace(config, seed=2)).volume, still, start=first.field)
    assert same.psnr_db > first.psnr_db - 0.2
    # A field that began otherwise is not made worse.
    plain = dataclasses.replace(short, start_from_data=False, learning_rate=1e-2)
    other = fit(before.volume, plain)
    kept = fit(after.volume, dataclasses.replace(short, steps=1, learning_rate=1e-6), start=other.field)
    assert kept.psnr_db > psnr_of_field(other.field, after.volume) - 0.01


def test_a_cancelled_start_changes_nothing():
    volume = make_phantom(PhantomConfig(shape=(24, 80, 48))).volume
    model = model_of(shape=(24, 80, 48))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    asked = iter([False] * 5 + [True])
    start_from_data(model, volume, lambda: next(asked))
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())
    assert next(asked, None) is None, "it is asked between B-scans, and stops at once"
