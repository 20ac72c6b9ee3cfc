"""Each artefact does to the light what its description says, inside its mask and nowhere else."""

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import ArtefactConfig, PhantomConfig, dye, glare, hair, make_phantom, membrane

SHAPE = (64, 100, 128)
KINDS = {
    "glare": ArtefactConfig(glare_spots=4),
    "shadow": ArtefactConfig(hairs=2),
    "layer": ArtefactConfig(detached_layer=True),
    "dye": ArtefactConfig(dye_patches=2),
}
RANGE_DB = PhantomConfig().dynamic_range_db


def phantom_of(kind, **settings):
    artefacts = KINDS[kind] if kind else ArtefactConfig()
    return make_phantom(PhantomConfig(shape=SHAPE, surface_depth_m=40 * 14.59e-6, artefacts=artefacts, **settings))


def lateral_grid():
    y, x = np.meshgrid(np.arange(SHAPE[0]) * 28e-6, np.arange(SHAPE[2]) * 14e-6, indexing="ij")
    return x, y


def mask_of(phantom):
    return phantom.artefact_mask(*lateral_grid())


def level(phantom):
    """Mean power above black, dB, [bscan, axial, lateral]."""
    return phantom.tissue.level_db(np.arange(SHAPE[0]))


def below(phantom):
    x, y = lateral_grid()
    return np.arange(SHAPE[1])[:, None] * 14.59e-6 - phantom.surface_depth_m(x, y)[:, None, :]


@pytest.fixture(scope="module")
def plain():
    return phantom_of(None)


def test_a_plain_phantom_has_no_mask(plain):
    assert not mask_of(plain).any()


@pytest.mark.parametrize("kind", KINDS)
def test_mask_holds_what_the_artefact_changes_near_the_surface(kind, plain):
    spoilt = phantom_of(kind)
    mask = mask_of(spoilt)
    assert 0.005 < mask.mean() < 0.45
    change = np.abs(level(spoilt) - level(plain))
    near = np.abs(below(plain)) < 60e-6
    outside = near & ~mask[:, None, :]
    # Outside it the surface stays within what a specular ring adds; most of it is not touched at all.
    assert change[outside].max() < 2.5
    assert np.quantile(change[outside], 0.9) < 0.05
    assert (np.where(near, change, 0.0).max(axis=1)[mask] > 0.1).mean() > 0.9
    np.testing.assert_array_equal(spoilt.surface_depth_m(*lateral_grid()), plain.surface_depth_m(*lateral_grid()))


def test_glare_saturates_the_surface_and_lifts_the_whole_column(plain):
    spoilt = phantom_of("glare")
    saturated = (spoilt.volume.array == 255) & (np.abs(below(spoilt)) < 30e-6)
    assert (plain.volume.array == 255).sum() == 0
    assert saturated.sum() > 20
    columns = saturated.any(axis=1)
    assert mask_of(spoilt)[columns].all()
    top = spoilt.truth.array[:, 0] - plain.truth.array[:, 0]
    assert top.max() > 0.25
    # Side lobes: above the surface, brighter than the streak by itself at the same place.
    column = np.unravel_index(np.argmax(top), top.shape)
    lobes = level(spoilt)[column[0], :, column[1]]
    air = below(spoilt)[column[0], :, column[1]] < -60e-6
    assert lobes[air].max() > lobes[0] + 3.0


def test_glare_sits_where_the_surface_is_square_to_the_beam(plain):
    spots = phantom_of("glare").tissue._artefacts[0].places_m
    lean = plain.surface_normal(spots[:, 0], spots[:, 1])[:, 2]
    assert (lean > np.quantile(plain.surface_normal(*lateral_grid())[..., 2], 0.75)).all()
    assert len(spots) == 4


def test_a_hair_is_bright_and_takes_the_light_from_everything_below(plain):
    spoilt = phantom_of("shadow")
    x, y = lateral_grid()
    core = np.zeros(x.shape, dtype=bool)
    for one in spoilt.tissue._artefacts:
        core |= np.abs(one.normal[0] * x + one.normal[1] * y - one.place_m) < 15e-6
    assert core.sum() > 50
    tissue = (below(spoilt) > 30e-6) & (below(spoilt) < 200e-6) & core[:, None, :]
    air_db = spoilt.config.air_level_db
    dark, lit = (10 ** ((level(p)[tissue] - air_db) / 10) - 1.0 for p in (spoilt, plain))
    np.testing.assert_allclose(10 * np.log10(dark.mean() / lit.mean()), hair.TRANSMISSION_DB, atol=1.0)
    above = (below(spoilt) < -80e-6) & core[:, None, :]
    assert level(spoilt)[above].max() > spoilt.config.air_level_db + spoilt.config.snr_db
    assert level(plain)[above].max() < spoilt.config.air_level_db + 0.1


def test_the_detached_layer_hangs_in_air_and_dims_the_tissue(plain):
    spoilt = phantom_of("layer")
    patch = spoilt.tissue._artefacts[0].patch
    inside = patch.share(*lateral_grid()) == 1.0
    assert inside.sum() > 100
    height = np.where(inside[:, None, :], below(spoilt), np.nan)
    bright = level(spoilt) > spoilt.config.air_level_db + spoilt.config.snr_db
    layer = bright & (height < -100e-6)
    assert layer.any(axis=1)[inside].all()
    extent = -height[layer]
    assert membrane.GAP_M[0] - 30e-6 < extent.min()
    assert extent.max() < membrane.GAP_M[1] + membrane.THICKNESS_M + 30e-6
    gap = (height < -60e-6) & (height > -membrane.GAP_M[0] + 60e-6)
    assert level(spoilt)[gap].max() < spoilt.config.air_level_db + 0.5
    tissue = height > 40e-6
    lost = level(plain)[tissue] - level(spoilt)[tissue]
    assert -membrane.TRANSMISSION_DB * 0.5 < np.median(lost) < -membrane.TRANSMISSION_DB + 0.01


def test_dye_changes_the_surface_and_dims_what_lies_below(plain):
    spoilt = phantom_of("dye")
    change = level(spoilt) - level(plain)
    depth = below(spoilt)
    for patch_of_dye in spoilt.tissue._artefacts:
        inside = (patch_of_dye.patch.share(*lateral_grid()) == 1.0)[:, None, :]
        deep = inside & (depth > 120e-6) & (depth < 180e-6)
        passed_db = 10 * np.log10(np.e) * 2 * dye.ATTENUATION_PER_M * dye.THICKNESS_M
        assert -passed_db - 0.1 < change[deep].mean() < -0.7 * passed_db
        at_surface = change[inside & (np.abs(depth) < 8e-6)].mean()
        assert np.sign(at_surface) == np.sign(patch_of_dye.gain_db)
    assert {spot.gain_db for spot in spoilt.tissue._artefacts} == set(dye.GAINS_DB)


@pytest.mark.parametrize("kind", KINDS)
def test_truth_of_spoilt_phantoms_is_the_mean_of_many_draws(kind):
    artefacts = KINDS[kind]
    configs = [
        PhantomConfig(shape=(10, 60, 40), surface="flat", speckle="single-look", seed=seed, artefacts=artefacts)
        for seed in range(60)
    ]
    draws = [make_phantom(config) for config in configs]
    error = np.mean([draw.volume.normalized() for draw in draws], axis=0, dtype=np.float64) - draws[0].truth.array
    assert abs(error.mean()) < 1e-3
    assert np.abs(error).max() < 6 * 0.12 / np.sqrt(60)


def test_several_artefacts_go_together():
    every = ArtefactConfig(glare_spots=2, hairs=1, detached_layer=True, dye_patches=2, axial_jitter_m=4e-6, jump_m=5e-5)
    phantom = make_phantom(PhantomConfig(shape=SHAPE, artefacts=every))
    assert np.isfinite(phantom.truth.array).all()
    assert 0.05 < mask_of(phantom).mean() < 0.7


def test_places_follow_the_tissue_seed_and_not_the_speckle():
    config = PhantomConfig(shape=(16, 60, 40), artefacts=KINDS["glare"])
    one, other, elsewhere = (
        make_phantom(PhantomConfig(shape=config.shape, artefacts=config.artefacts, seed=seed, tissue_seed=tissue))
        for seed, tissue in ((0, 0), (1, 0), (0, 1))
    )
    np.testing.assert_array_equal(one.truth.array, other.truth.array)
    assert np.abs(one.truth.array - elsewhere.truth.array).max() > 0.2


def test_more_spots_than_fit_apart_still_find_a_place():
    config = PhantomConfig(shape=(16, 60, 40), artefacts=ArtefactConfig(glare_spots=30))
    assert len(make_phantom(config).tissue._artefacts[0].places_m) == 30


@pytest.mark.parametrize(
    "values", [{"glare_spots": -1}, {"hairs": 99}, {"axial_jitter_m": -1e-6}, {"jump_m": 1.0}, {"dye_patches": 1.5}]
)
def test_impossible_artefacts_are_refused(values):
    with pytest.raises(ConfigurationError, match=f"ArtefactConfig.{next(iter(values))}: expected"):
        ArtefactConfig(**values)


def test_glare_mask_reaches_as_far_as_the_streak():
    spot = glare.Glare(np.array([[0.0, 0.0]]), 10**5.3)
    x = np.linspace(0, 300e-6, 3001)
    weight = np.exp(-0.5 * (x / glare.SPOT_RADIUS_M) ** 2)
    edge = x[spot.mask(x, 0.0)].max()
    assert edge == pytest.approx(np.interp(-glare.MASKED_POWER, -weight * 10**5.3, x), abs=1e-6)
    streak = 10 ** (glare.STREAK_OVER_AIR_DB / 10) * np.interp(edge, x, weight)
    assert streak < 0.01
