import numpy as np
import pytest
from scipy.special import polygamma

from octn_ros.errors import ConfigurationError
from octn_ros.simulation.speckle import Speckle, averaged_looks

SHAPE = (8, 100, 256)


@pytest.mark.parametrize("range_db", [20.0, 50.0, 100.0])
def test_averaged_looks_give_the_variance_of_31_db(range_db):
    spread = 10 / np.log(10) * np.sqrt(polygamma(1, averaged_looks(range_db))) / range_db
    assert -20 * np.log10(spread) == pytest.approx(31.0, abs=1e-6)


@pytest.mark.parametrize("grain", [0.0, 1.2])
@pytest.mark.parametrize("kind", ["single-look", "averaged"])
def test_power_is_gamma_distributed_with_unit_mean(kind, grain):
    speckle = Speckle.named(kind, 50.0, grain)
    power = 10 ** (speckle.draw_db(np.random.default_rng(0), SHAPE).astype(np.float64) / 10)
    assert power.mean() == pytest.approx(1.0, abs=0.01)
    assert power.var() == pytest.approx(1.0 / speckle.looks, rel=0.03)
    if kind == "single-look":
        assert (power < 0.1).mean() == pytest.approx(1 - np.exp(-0.1), abs=3e-3)


def test_grain_correlates_neighbours_along_the_lateral_axis_only():
    gain = Speckle.named("averaged", 50.0, 2.0).draw_db(np.random.default_rng(0), SHAPE).astype(np.float64)
    gain -= gain.mean()

    def correlation(axis, lag):
        return np.mean(gain * np.roll(gain, lag, axis=axis)) / gain.var()

    assert correlation(2, 2) == pytest.approx(np.exp(-1), abs=0.03)
    assert abs(correlation(1, 1)) < 0.02
    assert abs(correlation(0, 1)) < 0.02
    white = Speckle.named("averaged", 50.0).draw_db(np.random.default_rng(0), SHAPE)
    assert abs(np.corrcoef(white[..., 1:].ravel(), white[..., :-1].ravel())[0, 1]) < 0.02


def test_drawing_in_parts_continues_the_same_sequence():
    speckle = Speckle.named("single-look", 50.0, 1.2)
    whole = speckle.draw_db(np.random.default_rng(3), (4, 16, 32))
    generator = np.random.default_rng(3)
    parts = [speckle.draw_db(generator, (n, 16, 32)) for n in (1, 3)]
    np.testing.assert_array_equal(whole, np.concatenate(parts))


@pytest.mark.parametrize("kind", ["single-look", "averaged"])
def test_expected_display_is_the_mean_of_the_clipped_display(kind):
    speckle = Speckle.named(kind, 50.0)
    gain = speckle.draw_db(np.random.default_rng(0), SHAPE).astype(np.float64)
    levels = np.array([0.0, 5.0, 12.0, 27.0, 49.0])
    drawn = [np.clip((level + gain) / 50.0, 0, 1).mean() for level in levels]
    np.testing.assert_allclose(speckle.expected_display(levels, 50.0), drawn, atol=1e-3)


def test_unknown_name_is_refused():
    with pytest.raises(ConfigurationError, match="single-look or averaged, got 'pink'"):
        Speckle.named("pink", 50.0)
