import dataclasses

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import ArtefactConfig, PhantomConfig, make_phantom

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
    draws = [make_phantom(dataclasses.replace(config, seed=seed)) for seed in range(120)]
    mean = np.mean([draw.volume.normalized() for draw in draws], axis=0, dtype=np.float64)
    error = mean - draws[0].truth.array
    spread = np.std([draw.volume.normalized() for draw in draws]) / np.sqrt(120)
    assert np.abs(error).max() < 5 * spread
    assert abs(error.mean()) < 1e-3


def test_truth_does_not_depend_on_the_seed():
    one, other = (make_phantom(dataclasses.replace(SMALL, seed=seed)) for seed in (1, 2))
    np.testing.assert_array_equal(one.truth.array, other.truth.array)
    assert (one.volume.array != other.volume.array).mean() > 0.5


ALL_ARTEFACTS = ArtefactConfig(glare_spots=3, hairs=2, detached_layer=True, dye_patches=2)


@pytest.mark.parametrize("surface", ["wavy", "rough", "stepped", "steep"])
@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_tissue_turned_by_quarters_is_the_turned_truth(surface, quarters):
    # Square voxels and whole ones of shift: the lattices coincide, so nothing is interpolated.
    still = PhantomConfig(
        shape=(64, 96, 64), spacing_m=(20e-6, 15e-6, 20e-6), surface=surface, artefacts=ALL_ARTEFACTS,
        surface_depth_m=0.6e-3, steepest_deg=20.0, wave_period_m=1e-3,
    )  # fmt: skip
    moved = dataclasses.replace(still, rotation_deg=90.0 * quarters, shift_m=(40e-6, -60e-6, 30e-6))
    one, other = make_phantom(still), make_phantom(moved)
    # From lateral towards bscan: index (bscan, lateral) goes to (lateral, last - bscan).
    turned = np.rot90(one.truth.array, quarters, axes=(2, 0))
    np.testing.assert_allclose(other.truth.array[:61, 2:, 2:], turned[3:, :-2, :-2], atol=2e-4)
    assert np.abs(other.truth.array - one.truth.array).max() > 0.1
    x, y = np.meshgrid(np.arange(64) * 20e-6, np.arange(64) * 20e-6)
    np.testing.assert_array_equal(
        other.artefact_mask(x, y)[:61, 2:], np.rot90(one.artefact_mask(x, y), quarters, axes=(1, 0))[3:, :-2]
    )


@pytest.mark.parametrize(("rotation_deg", "surface"), [(25.0, "wavy"), (-130.0, "tilted"), (200.0, "rough")])
def test_tissue_turned_and_shifted_is_the_same_tissue_seen_elsewhere(rotation_deg, surface):
    still = PhantomConfig(shape=(60, 96, 110), surface=surface, surface_depth_m=0.5e-3, tilt_deg=4.0)
    shift = (60e-6, -40e-6, 33e-6)
    one, other = make_phantom(still), make_phantom(dataclasses.replace(still, rotation_deg=rotation_deg, shift_m=shift))
    generator = np.random.default_rng(0)
    width, length, _ = one.volume.geometry.extent_m
    radius, angle = generator.uniform(0, 0.55e-3, 4000), generator.uniform(0, 2 * np.pi, 4000)
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), generator.uniform(0.1e-3, 1.3e-3, 4000)
    cos, sin = np.cos(np.radians(rotation_deg)), np.sin(np.radians(rotation_deg))
    here = (width / 2 + x, length / 2 + y, z)
    there = (width / 2 + cos * x - sin * y + shift[0], length / 2 + sin * x + cos * y + shift[1], z + shift[2])
    levels = [
        map_coordinates(phantom.truth.array, [place[1] / 28e-6, place[2] / 14.59e-6, place[0] / 14e-6], order=3)
        for phantom, place in ((one, here), (other, there))
    ]
    # Cubic interpolation of the edge, 20 um wide in voxels of 14.59 um, is good to a few per cent of its height.
    assert np.abs(levels[0] - levels[1]).max() < 0.04
    assert np.sqrt(np.mean((levels[0] - levels[1]) ** 2)) < 4e-3
    np.testing.assert_allclose(
        one.surface_depth_m(*here[:2]) + shift[2], other.surface_depth_m(*there[:2]), rtol=0, atol=1e-12
    )
    normal, turned = one.surface_normal(*here[:2]), other.surface_normal(*there[:2])
    expected = np.stack([cos * normal[:, 0] - sin * normal[:, 1], sin * normal[:, 0] + cos * normal[:, 1]], axis=-1)
    np.testing.assert_allclose(turned[:, :2], expected, atol=1e-12)


def test_a_bright_top_layer_lies_on_top_and_nowhere_else():
    plain, layered = (
        make_phantom(PhantomConfig(shape=(8, 96, 16), surface="flat", surface_depth_m=30 * 14.59e-6, top_layer_db=gain))
        for gain in (0.0, 8.0)
    )
    rise_db = 50.0 * (layered.truth.array - plain.truth.array)[4, :, 8]
    below_m = (np.arange(96) - 30) * 14.59e-6
    np.testing.assert_allclose(rise_db[(below_m > 20e-6) & (below_m < 55e-6)], 8.0, atol=0.3)
    np.testing.assert_allclose(rise_db[(below_m < -30e-6) | (below_m > 110e-6)], 0.0, atol=0.01)


def test_an_open_depth_leaves_air_above_the_highest_place():
    config = PhantomConfig(shape=(64, 192, 128), surface="tilted", tilt_deg=30.0)
    x, y = np.linspace(0, 127 * 14e-6, 50), np.linspace(0, 63 * 28e-6, 50)[:, None]
    assert config.true_surface().depth_at(x, y).min() == pytest.approx(10 * 14.59e-6)
    assert PhantomConfig().true_surface().depth_m == pytest.approx(159 * 14.59e-6 / 4)


def test_strong_attenuation_far_above_deep_tissue_stays_finite():
    config = PhantomConfig(shape=(4, 500, 8), surface="flat", surface_depth_m=6.5e-3, attenuation_per_m=20000.0)
    assert np.isfinite(make_phantom(config).truth.array).all()


def test_truth_helpers_agree(default_phantom):
    x, y = np.linspace(0, 3.5e-3, 7), np.linspace(0, 3.5e-3, 5)[:, None]
    points = default_phantom.surface_point(x, y)
    assert points.shape == (5, 7, 3)
    np.testing.assert_array_equal(points[..., 2], default_phantom.surface_depth_m(x, y))
    np.testing.assert_allclose(default_phantom.surface.distance(points), 0.0, atol=1e-12)
    assert default_phantom.surface is default_phantom.surface_at_rest
    assert not default_phantom.artefact_mask(x, y).any()


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
    config = PhantomConfig(
        shape=(7, 60, 30), grain_voxels=1.2, artefacts=dataclasses.replace(ALL_ARTEFACTS, axial_jitter_m=5e-6)
    )
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
        ({"surface": "round"}, "flat, tilted, wavy, rough, stepped, steep"),
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
