import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import ArtefactConfig, PhantomConfig, make_phantom

CONFIG = PhantomConfig(shape=(24, 96, 48), attenuation_per_m=0.0, asymmetric=False)
SPACING_M = CONFIG.spacing_m


def crater(depth_m):
    removed = np.zeros((24, 48))
    removed[8:16, 12:30] = depth_m
    return removed


def test_nothing_removed_is_the_same_phantom():
    whole, cut = make_phantom(CONFIG), make_phantom(CONFIG, np.zeros((24, 48)))
    np.testing.assert_array_equal(whole.volume.array, cut.volume.array)
    np.testing.assert_array_equal(whole.truth.array, cut.truth.array)


def test_surface_lies_deeper_where_tissue_was_removed():
    removed = crater(120e-6)
    whole, cut = make_phantom(CONFIG), make_phantom(CONFIG, removed)
    x, y = np.arange(48) * SPACING_M[2], (np.arange(24) * SPACING_M[0])[:, None]
    np.testing.assert_allclose(cut.surface_depth_m(x, y) - whole.surface_depth_m(x, y), removed, atol=1e-15)
    # Bilinear in between.
    middle = cut.surface_depth_m(20 * SPACING_M[2], 7.5 * SPACING_M[0])
    assert middle - whole.surface_depth_m(20 * SPACING_M[2], 7.5 * SPACING_M[0]) == pytest.approx(60e-6)
    edges = [np.argmax(phantom.truth.array > 0.46, axis=1) for phantom in (whole, cut)]
    np.testing.assert_allclose((edges[1] - edges[0]) * SPACING_M[1], removed, atol=SPACING_M[1])
    inside = removed > 0
    np.testing.assert_array_equal(whole.truth.array[~inside[:, None, :].repeat(96, 1)],
                                  cut.truth.array[~inside[:, None, :].repeat(96, 1)])  # fmt: skip


def test_layers_below_a_crater_stay_where_they_were():
    whole, cut = make_phantom(CONFIG), make_phantom(CONFIG, crater(120e-6))
    # Deeper than the crater's edge and its point spread, without attenuation, nothing has changed.
    deep = np.arange(96)[:, None] * SPACING_M[1] > whole.surface_depth_m(20 * SPACING_M[2], 0.0) + 300e-6
    both = [phantom.truth.array[10, :, 20] for phantom in (whole, cut)]
    np.testing.assert_allclose(both[0][deep[:, 0]], both[1][deep[:, 0]], atol=1e-6)


def test_a_crater_moves_with_its_tissue():
    config = PhantomConfig(shape=(24, 96, 48), artefacts=ArtefactConfig(axial_jitter_m=8e-6))
    removed = crater(100e-6)
    whole, cut = make_phantom(config), make_phantom(config, removed)
    x, y = np.arange(48) * SPACING_M[2], (np.arange(24) * SPACING_M[0])[:, None]
    np.testing.assert_allclose(cut.surface_depth_m(x, y) - whole.surface_depth_m(x, y), removed, atol=1e-15)


@pytest.mark.parametrize(
    "removed", [np.zeros((48, 24)), np.zeros(24), -crater(1e-6), np.full((24, 48), np.nan), np.zeros((0, 48))]
)
def test_impossible_craters_are_refused(removed):
    with pytest.raises(ConfigurationError, match="crater: expected"):
        make_phantom(CONFIG, removed)
