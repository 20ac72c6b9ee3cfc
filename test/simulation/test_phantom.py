import dataclasses

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import PhantomConfig, make_phantom

SMALL = PhantomConfig(shape=(12, 96, 40))


def psnr_db(a, b):
    return -10 * np.log10(np.mean((a.astype(np.float64) - b) ** 2))


@pytest.fixture(scope="module")
def default_phantom():
    return make_phantom()


def test_default_phantom_lies_31_db_from_its_truth_and_is_not_clipped(default_phantom):
    noisy, truth = default_phantom.volume.normalized(), default_phantom.truth.normalized()
    assert psnr_db(noisy, truth) == pytest.approx(31.0, abs=0.3)
    assert np.isin(default_phantom.volume.array, (0, 255)).mean() < 1e-5
    assert abs((noisy - truth).mean(dtype=np.float64)) < 1e-4


def test_default_phantom_holds_a_raster_of_3_mm_and_tissue_through_most_of_its_depth(default_phantom):
    geometry = default_phantom.volume.geometry
    width, length, depth = geometry.extent_m
    assert min(width, length) > 3.4e-3
    assert geometry.spacing_m == (28e-6, 14.59e-6, 14e-6)
    x, y = np.linspace(0, width, 100), np.linspace(0, length, 100)[:, None]
    assert default_phantom.surface_depth_m(x, y).max() < 0.35 * depth
    truth = default_phantom.truth.array
    assert truth[:, -1].min() > truth[:, 0].max() + 0.05, "the deepest tissue is still brighter than air"


@pytest.mark.parametrize("speckle", ["averaged", "single-look"])
@pytest.mark.parametrize("grain", [0.0, 1.2])
@pytest.mark.parametrize("range_db", [40.0, 60.0])
def test_every_averaged_phantom_lies_31_db_from_its_truth(speckle, grain, range_db):
    phantom = make_phantom(
        PhantomConfig(shape=(32, 64, 64), speckle=speckle, grain_voxels=grain, dynamic_range_db=range_db)
    )
    psnr = psnr_db(phantom.volume.normalized(), phantom.truth.array)
    if speckle == "averaged":
        assert psnr == pytest.approx(31.0, abs=0.3)
    else:
        assert psnr < 23.0


@pytest.mark.parametrize("speckle", ["averaged", "single-look"])
def test_truth_is_the_mean_of_many_draws(speckle):
    config = PhantomConfig(shape=(4, 24, 12), speckle=speckle)
    draws = [make_phantom(dataclasses.replace(config, seed=seed)) for seed in range(250)]
    mean = np.mean([draw.volume.normalized() for draw in draws], axis=0, dtype=np.float64)
    error = mean - draws[0].truth.array
    spread = np.std([draw.volume.normalized() for draw in draws]) / np.sqrt(250)
    assert np.abs(error).max() < 5 * spread
    assert abs(error.mean()) < 3e-4


def test_truth_does_not_depend_on_the_seed():
    one, other = (make_phantom(dataclasses.replace(SMALL, seed=seed)) for seed in (1, 2))
    np.testing.assert_array_equal(one.truth.array, other.truth.array)
    assert (one.volume.array != other.volume.array).mean() > 0.5


def test_same_seed_gives_the_same_phantom():
    np.testing.assert_array_equal(make_phantom(SMALL).volume.array, make_phantom(SMALL).volume.array)


@pytest.mark.parametrize("depth_m", [0.3e-3, 0.305e-3, 0.31e-3])
@pytest.mark.parametrize("surface", ["flat", "tilted", "wavy"])
def test_truth_rises_at_the_surface(surface, depth_m):
    # With the slope of the top layer and the point spread known, the truth passes half the tissue's power at the
    # surface itself; display levels are compared there, between voxels.
    config = PhantomConfig(
        shape=(24, 96, 64), surface=surface, surface_depth_m=depth_m, tilt_deg=10.0, attenuation_per_m=0.0
    )
    phantom = make_phantom(config)
    truth, (d, h, w) = phantom.truth.array.astype(np.float64), config.spacing_m
    air, tissue = truth[:, 0].mean(), np.quantile(truth[:, 30], 0.9)
    ratio = 10 ** (config.snr_db / 10)
    half = air + 10 * np.log10((1 + ratio) / 2) / config.dynamic_range_db
    assert tissue - air == pytest.approx(config.snr_db / config.dynamic_range_db, abs=2e-3)
    below = np.argmax(truth > half, axis=1)
    low, high = (np.take_along_axis(truth, k[:, None], axis=1)[:, 0] for k in (below - 1, below))
    depth = (below - 1 + (half - low) / (high - low)) * h
    y, x = np.meshgrid(np.arange(24) * d, np.arange(64) * w, indexing="ij")
    # Linear interpolation of a curved edge costs a few micrometres of the 14.59 um voxel.
    np.testing.assert_allclose(depth, phantom.surface_depth_m(x, y), atol=4e-6)
    assert abs(np.mean(depth - phantom.surface_depth_m(x, y))) < 3e-6


@pytest.mark.parametrize("snr_db", [8.0, 15.0])
def test_snr_is_tissue_just_below_the_surface_over_air(snr_db):
    phantom = make_phantom(PhantomConfig(shape=(64, 96, 64), surface="flat", snr_db=snr_db, speckle="single-look"))
    power = 10 ** (phantom.volume.normalized().astype(np.float64) * 5.0)
    surface_row = round(float(phantom.surface_depth_m(0, 0)) / phantom.config.spacing_m[1])
    # Air is partly clipped to black in single-look speckle, which bounds its mean from below.
    measured = 10 * np.log10(power[:, surface_row + 3].mean() / power[:, : surface_row - 4].mean())
    assert measured == pytest.approx(snr_db, abs=0.6)


@pytest.mark.parametrize("surface", ["flat", "wavy"])
def test_mirrored_and_swapped_axes_are_noticed(surface):
    truth = make_phantom(PhantomConfig(shape=(40, 60, 40), surface=surface)).truth.array
    for changed in (truth[::-1], truth[:, ::-1], truth[:, :, ::-1], truth[::-1, :, ::-1], truth.transpose(2, 1, 0)):
        assert np.mean(np.abs(changed - truth) > 0.05) > 0.01
    plain = make_phantom(PhantomConfig(shape=(40, 60, 40), surface="flat", asymmetric=False)).truth.array
    np.testing.assert_array_equal(plain, plain[::-1, :, ::-1])


@pytest.mark.parametrize("shape", [(2, 2, 2), (3, 300, 5), (9, 31, 7)])
def test_any_size_works(shape):
    phantom = make_phantom(PhantomConfig(shape=shape, surface="flat"))
    assert phantom.volume.array.shape == phantom.truth.array.shape == shape
    assert (phantom.volume.array.dtype, phantom.truth.array.dtype) == (np.uint8, np.float32)


def test_slabs_leave_no_trace(monkeypatch):
    config = PhantomConfig(shape=(7, 60, 30), grain_voxels=1.2)
    whole = make_phantom(config)
    monkeypatch.setattr("octn_ros.simulation.phantom._SLAB_VOXELS", 3 * 60 * 30)
    parts = make_phantom(config)
    np.testing.assert_array_equal(whole.volume.array, parts.volume.array)
    np.testing.assert_array_equal(whole.truth.array, parts.truth.array)


def test_name_tells_surface_speckle_grain_snr_and_seed():
    assert PhantomConfig(seed=7, grain_voxels=1.2).name == "wavy averaged grain1.2 snr15 seed7"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"speckle": "none"}, "single-look, averaged"),
        ({"surface": "round"}, "flat, tilted, wavy"),
        ({"snr_db": 0.0}, "at least 1"),
        ({"shape": (1, 8, 8)}, "at least 2"),
        ({"spacing_m": (28e-6, 0.0, 14e-6)}, "at least 1e-07"),
        ({"surface_depth_m": 5e-3}, "expected a surface between 0 and 2320 um"),
        ({"tilt_deg": 40.0}, "change surface_depth_m, tilt_deg"),
        ({"seed": -1}, "at least 0"),
    ],
)
def test_impossible_phantoms_are_refused(values, message):
    with pytest.raises(ConfigurationError, match=message):
        PhantomConfig(**values)
