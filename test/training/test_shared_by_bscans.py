"""Learning from neighbours: what the tables hold, what the network may see, and what it is worth against the truth."""

import dataclasses

import numpy as np
import pytest
import scipy.ndimage
import torch

from octn_ros.errors import ConfigurationError, TrainingError
from octn_ros.evaluation.interpolators import trilinear
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.metrics import psnr_db
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.training import PRESETS, fit
from octn_ros.training.neighbour_trainer import NeighbourTrainer
from octn_ros.training.scale_space import features_between, fill_with_scales, level_averages
from octn_ros.training.tissue_sheet import TissueSheet
from octn_ros.volume import Volume, gaussian_filter

SPARSE = PRESETS["sparse"]
QUICK = dataclasses.replace(SPARSE, steps=300, time_budget_s=0.0)
SHAPE = (9, 40, 24)


def never():
    return False


def model_of(shape, **grid):
    torch.manual_seed(0)
    config = dataclasses.replace(SPARSE.field.grid, **grid)
    return NeuralModel(NeuralFieldConfig(config, NetworkConfig(1, 16)), shape)


def volume_of(intensity):
    return Volume.from_array(np.float32(intensity), (28e-6, 14.59e-6, 14e-6), intensity_range=(0.0, 1.0))


def native(field):
    bscan, axial, lateral = (torch.linspace(-1, 1, n) for n in field.geometry.shape)
    return field.lattice(lateral, axial, bscan).numpy()


def random_volume(shape=SHAPE, seed=0):
    return volume_of(np.random.default_rng(seed).random(shape))


def wavy_sheet(shape):
    bscan, lateral = np.meshgrid(np.arange(shape[0]), np.arange(shape[2]), indexing="ij")
    return TissueSheet(0.3 * shape[1] * (1.0 + 0.5 * np.sin(0.7 * bscan + 0.2 * lateral)))


def flat_sheet(shape):
    return TissueSheet(np.full((shape[0], shape[2]), 7.0))


def test_levels_keep_bscans_and_depths_apart_and_double_across_the_beam():
    """One cell from each B-scan to the next and from voxel to voxel along the beam at every level, whatever the longest
    axis; averages are as wide as the cells."""
    for shape in [(9, 40, 24), (200, 40, 24)]:
        lateral, axial, bscan = zip(*SPARSE.field.grid.level_scales(shape), strict=True)
        assert bscan == (shape[0] - 1,) * 3
        np.testing.assert_allclose(axial, [40 - 1] * 3)
        np.testing.assert_allclose(lateral, [24 / 2**k - 1 for k in (2, 1, 0)])
        averages = level_averages(model_of(shape).grid.grid_levels, shape)
        assert [along.lateral for along, _ in averages] == [5.0, 2.5, 0.0]
        assert [(place.lateral, place.axial) for _, place in averages] == [(8.0, 3.0), (4.0, 1.5), (0.0, 0.0)]
        assert [(along.axial, along.slow, place.slow) for along, place in averages] == [(0, 2, 2), (0, 1, 1), (0, 0, 0)]
    with pytest.raises(ConfigurationError, match="lateral_growth"):
        HashGridConfig(lateral_growth=0.5)


@pytest.mark.parametrize("interpolation", ["linear", "smoothstep"])
@pytest.mark.parametrize("cells", [1.0, 3.0])
@pytest.mark.parametrize("sheet_of", [flat_sheet, wavy_sheet])
def test_what_a_bscan_is_predicted_from_is_a_filled_grid(interpolation, cells, sheet_of):
    """The short way, two layers, equals a table made of the same B-scans and asked at the voxels between them."""
    volume = random_volume((6, 21, 17))
    sheet = sheet_of(volume.geometry.shape)
    grid = model_of(volume.geometry.shape, cells_per_bscan=cells, interpolation=interpolation).grid
    assert fill_with_scales(grid, volume.normalized, sheet, volume.geometry.shape, never)
    for position in (2.5, 1.0, 4.75):
        lateral, axial = torch.linspace(-1, 1, 17), torch.linspace(-1, 1, 21)
        asked = grid.forward_lattice(lateral, axial, torch.tensor([position / 2.5 - 1.0]))
        depth = sheet.at(np.array([position]))[0]
        short = features_between(grid.grid_levels, volume.array, sheet, position, depth)
        np.testing.assert_allclose(short, asked.reshape(-1, grid.width).numpy(), atol=2e-5)


def test_every_scale_of_a_linear_volume_is_the_volume():
    """Means around the vertices of a plane are the plane, away from the borders."""
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (10, 80, 120)), indexing="ij")
    volume = volume_of(0.1 + 0.3 * z + 0.2 * y + 0.3 * x)
    grid = model_of(volume.geometry.shape).grid
    fill_with_scales(grid, volume.normalized, flat_sheet(volume.geometry.shape), volume.geometry.shape, never)
    axes = [torch.linspace(-1, 1, n) for n in (120, 80, 10)]
    inside = (slice(3, -3), slice(20, -20), slice(40, -40))
    features = grid.forward_lattice(*axes)[inside].numpy()
    np.testing.assert_allclose(features, np.broadcast_to(volume.array[inside][..., None], features.shape), atol=5e-3)


def test_a_table_made_slab_by_slab_is_the_same(monkeypatch):
    """Scans too large to be worked on at once: slabs see as much of their neighbours as the widest average does."""
    volume = random_volume((23, 20, 16))
    tables = []
    for voxels in (1 << 23, 4 * 20 * 16):
        monkeypatch.setattr("octn_ros.training.scale_space._SLAB_VOXELS", voxels)
        grid = model_of(volume.geometry.shape, cells_per_bscan=3.0).grid
        assert fill_with_scales(grid, volume.normalized, wavy_sheet((23, 20, 16)), (23, 20, 16), never)
        tables.append(grid.table.detach().numpy())
    np.testing.assert_allclose(tables[1], tables[0], atol=1e-6)


def test_along_a_sheet_tissue_that_follows_it_is_kept_whole():
    """Layers on a slope: however wide the average along them, they stay as they are, and in place they blur."""
    shape = (20, 110, 64)
    sheet = TissueSheet(np.float64(20.0 + 1.5 * np.arange(20)[:, None] + 0.3 * np.arange(64)[None, :]))
    below = np.arange(110)[None, :, None] - sheet.depth[:, None, :]
    volume = volume_of(0.5 + 0.4 * np.sin(0.5 * below))
    grid = model_of(shape, cells_per_bscan=2.0).grid
    assert fill_with_scales(grid, volume.normalized, sheet, shape, never)
    axes = [torch.linspace(-1, 1, n) for n in (64, 110, 20)]
    inside = (slice(7, -7), slice(40, -40), slice(20, -20))
    coarsest = grid.forward_lattice(*axes)[inside].numpy()[..., :2]
    wrong = [np.abs(coarsest[..., feature] - volume.array[inside]).max() for feature in range(2)]
    assert wrong[0] < 0.03
    assert wrong[1] > 0.3


def test_a_bscan_is_never_predicted_from_itself():
    """Predictions of a B-scan stay as they are when its own voxels change, and those of its neighbours do not."""
    volume = random_volume()
    sheet = wavy_sheet(SHAPE)
    other = volume.array.copy()
    other[4] = 1.0 - other[4]
    model = model_of(SHAPE)
    trainers = [NeighbourTrainer(model, v, sheet, 64, 0, never) for v in (volume, volume_of(other))]
    samples = SHAPE[1] * SHAPE[2]
    # Whitening mixes all samples: undone here.
    features = [t._features.numpy() @ np.linalg.inv(t._to_white.numpy()) + t._mean.numpy() for t in trainers]
    of_fourth = slice(3 * samples, 4 * samples)  # B-scans 1 to 7 are predicted
    np.testing.assert_allclose(features[0][of_fourth], features[1][of_fourth], atol=1e-4)
    of_third = slice(2 * samples, 3 * samples)
    assert np.abs(features[0][of_third] - features[1][of_third]).max() > 0.1


def test_it_is_nearer_to_the_truth_than_a_gaussian():
    """On a phantom by at least 2 dB, on the scan's own grid and at B-scans that were not measured."""
    phantom = make_phantom(named_phantom("wavy-13dB-averaged", shape=(33, 128, 64)))
    measured, truth = phantom.volume.normalized(slice(None)), phantom.truth.normalized(slice(None))
    field = fit(phantom.volume, QUICK).field
    smooth = gaussian_filter(phantom.volume, 1.0).normalized(slice(None))
    assert psnr_db(truth, native(field)) > psnr_db(truth, smooth) + 2.0

    every_second = fit(volume_of(measured[::2]), QUICK).field
    lateral, axial = torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 128)
    between = every_second.lattice(lateral, axial, torch.linspace(-1, 1, 33)[1::2]).numpy()
    blurred = scipy.ndimage.gaussian_filter(measured[::2], (0.0, 1.0, 1.0))
    linear = 0.5 * (blurred[1:] + blurred[:-1])
    assert psnr_db(truth[1::2], between) > psnr_db(truth[1::2], linear) + 2.0
    assert psnr_db(measured[1::2], between) > psnr_db(measured[1::2], linear)


@pytest.mark.parametrize("bscans", [3, 4, 5])
def test_few_bscans_are_no_worse_than_interpolated(bscans):
    """Where there is little to learn from, features that were never seen to differ must not run away with it."""
    phantom = make_phantom(named_phantom("wavy-13dB-averaged", shape=(8 * (bscans - 1) + 1, 64, 32)))
    truth = phantom.truth.normalized(slice(None))
    kept = phantom.volume.normalized(slice(None))[::8]
    field = fit(volume_of(kept), QUICK).field
    lateral, axial = torch.linspace(-1, 1, 32), torch.linspace(-1, 1, 64)
    between = field.lattice(lateral, axial, torch.linspace(-1, 1, len(truth))).numpy()
    assert psnr_db(truth, between) > psnr_db(truth, trilinear(kept, np.arange(len(truth)) / 8))


def test_the_network_that_was_learned_is_the_models():
    """Whitening is only a way to learn: model and trainer agree, and steps make the prediction better."""
    phantom = make_phantom(named_phantom("wavy-13dB-averaged", shape=(17, 64, 32)))
    model = model_of(phantom.volume.geometry.shape)
    trainer = NeighbourTrainer(model, phantom.volume, TissueSheet.of(phantom.volume, never), 4096, 0, never)
    points = torch.rand(50, 3) * 2 - 1
    trainer.evaluate(points)
    with torch.no_grad():
        white = (model.grid(points) - trainer._mean) @ trainer._to_white
        np.testing.assert_allclose(model(points), trainer._network(white), atol=2e-5)
    first = np.mean([trainer.step(1e-5, 0.0, never) for _ in range(20)])
    for _ in range(200):
        trainer.step(3e-3, 0.0, never)
    last = np.mean([trainer.step(1e-5, 0.0, never) for _ in range(20)])
    assert last < 0.999 * first


def test_a_seeded_fit_is_repeatable():
    """Same seed, same field; another seed, another one."""
    volume = random_volume()
    few = dataclasses.replace(QUICK, steps=20)
    first, again = (fit(volume, few).field for _ in range(2))
    assert torch.equal(first.model.network.output.weight, again.model.network.output.weight)
    other = fit(volume, dataclasses.replace(few, seed=1)).field
    assert not torch.equal(first.model.network.output.weight, other.model.network.output.weight)


def test_a_refit_goes_on_with_the_network_and_takes_the_new_scans_tables():
    """With hardly a step the field of a new scan is as good as that of a whole fit of it."""
    config = named_phantom("wavy-13dB-averaged", shape=(17, 64, 32))
    one, two = (make_phantom(dataclasses.replace(config, seed=seed)) for seed in (1, 2))
    truth = two.truth.normalized(slice(None))
    start = fit(one.volume, QUICK).field
    refitted = fit(two.volume, dataclasses.replace(QUICK, steps=1, learning_rate=1e-6), start=start).field
    anew = fit(two.volume, QUICK).field
    assert psnr_db(truth, native(refitted)) > psnr_db(truth, native(anew)) - 1.0


def test_cancelled_before_it_begins():
    """Whoever cancels while the tables are made gets no half-learned field as a finished one."""
    result = fit(random_volume(), QUICK, cancelled=lambda: True)
    assert (result.ended, result.steps) == ("cancelled", 0)


def test_what_cannot_be_learned_from_neighbours_is_refused():
    """Too few B-scans, levels that share rows, a start that is not from the data: refused in words."""
    with pytest.raises(TrainingError, match="at least 3 B-scans"):
        fit(random_volume((2, 24, 24)), QUICK)
    hashed = dataclasses.replace(SPARSE.field.grid, log2_table_size=6)
    with pytest.raises(TrainingError, match="every vertex"):
        fit(random_volume(), dataclasses.replace(QUICK, field=NeuralFieldConfig(hashed, SPARSE.field.network)))
    three = dataclasses.replace(SPARSE.field.grid, features=3)
    with pytest.raises(TrainingError, match="2 features"):
        fit(random_volume(), dataclasses.replace(QUICK, field=NeuralFieldConfig(three, SPARSE.field.network)))
    with pytest.raises(ConfigurationError, match="start_from_data"):
        dataclasses.replace(SPARSE, start_from_data=False)


def test_features_that_never_differ_do_no_harm():
    """B-scans all alike: a feature and its average over B-scans are one and the same, and the scan is given back."""
    axial, lateral = np.meshgrid(np.linspace(0, 6, 40), np.linspace(0, 4, 24), indexing="ij")
    volume = volume_of(np.broadcast_to(0.5 + 0.4 * np.sin(axial) * np.cos(lateral), SHAPE))
    assert psnr_db(volume.array, native(fit(volume, QUICK).field)) > 40.0
