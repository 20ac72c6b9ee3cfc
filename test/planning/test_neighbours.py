import tracemalloc

import numpy as np
import pytest

from octn_ros.planning.neighbours import allowed_deviation, deviation_from_neighbours, share_of_neighbours

PLACES = np.stack(np.meshgrid(np.arange(20) * 50e-6, np.arange(20) * 50e-6), axis=-1).reshape(-1, 2)
X, Y = PLACES.T
PLANE = 1e-3 + 0.4 * X - 0.2 * Y
FLOOR, LEAST, LIMIT = 3e-6, 11e-6, 30e-6


def deviation(depth, shape=None):
    return deviation_from_neighbours(PLACES, depth, PLANE if shape is None else shape, 24, FLOOR, LEAST, LIMIT)


def test_points_of_a_plane_do_not_deviate_and_one_that_does_is_measured():
    depth = PLANE.copy()
    depth[210] += 40e-6
    found, scatter = deviation(depth)
    assert found[210] == pytest.approx(40e-6, abs=0.1e-6)
    assert np.abs(np.delete(found, 210)).max() < 0.1e-6
    assert scatter.max() < 0.1e-6


def test_normal_scatter_is_estimated():
    noise = 5e-6 * np.random.default_rng(0).standard_normal(len(PLANE))
    found, scatter = deviation(PLANE + noise)
    assert np.median(scatter) == pytest.approx(5e-6, rel=0.15)
    assert (np.abs(found) > allowed_deviation(scatter, LEAST, LIMIT)).mean() < 0.01


def test_either_side_of_a_cliff_stands():
    found, scatter = deviation(PLANE + np.where(X > 480e-6, 300e-6, 0.0))
    assert (np.abs(found) > allowed_deviation(scatter, LEAST, LIMIT)).sum() == 0
    assert scatter.max() < LIMIT / 2


def test_a_crest_that_the_rougher_surface_shows_is_no_outlier():
    crest = PLANE + 300e-6 * np.exp(-((X - 500e-6) ** 2) / (2 * 70e-6**2))
    plain, spread = deviation(crest)
    told, its_spread = deviation(crest, shape=crest + 3e-6)
    misfits = [(np.abs(plain) > allowed_deviation(spread, LEAST, LIMIT)) | (spread > LIMIT / 2)]
    misfits.append((np.abs(told) > allowed_deviation(its_spread, LEAST, LIMIT)) | (its_spread > LIMIT / 2))
    assert misfits[0].sum() > 20
    assert not misfits[1].any()


def test_points_without_depth_are_not_asked_and_have_no_answer():
    depth = PLANE.copy()
    depth[[5, 17]] = np.nan
    found, scatter = deviation(depth)
    assert np.isinf(found[[5, 17]]).all()
    assert np.abs(np.delete(found, [5, 17])).max() < 0.1e-6
    lonely = np.full(len(PLANE), np.nan)
    lonely[:2] = 1e-3
    found, scatter = deviation(lonely)
    assert found[:2].tolist() == [0.0, 0.0]
    assert np.isinf(scatter[2:]).all()


def test_points_on_one_line_have_a_plane_too():
    line = np.column_stack([np.arange(30) * 50e-6, np.zeros(30)])
    depth = 1e-3 + 0.5 * line[:, 0]
    depth[12] -= 50e-6
    found, _ = deviation_from_neighbours(line, depth, 1e-3 + 0.5 * line[:, 0], 8, FLOOR, LEAST, LIMIT)
    assert found[12] == pytest.approx(-50e-6, abs=0.5e-6)


def test_many_points_are_taken_in_parts():
    side = np.arange(200) * 50e-6
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    depth = 1e-3 + places @ (0.4, -0.2)
    depth[::1000] += 40e-6
    tracemalloc.start()
    try:
        found, _ = deviation_from_neighbours(places, depth, places @ (0.4, -0.2), 24, FLOOR, LEAST, LIMIT)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_allclose(found[::1000], 40e-6, atol=0.1e-6)
    assert np.abs(np.delete(found, np.arange(0, len(depth), 1000))).max() < 0.1e-6
    assert peak < 60e6  # all at once they take 170 MB


def test_the_share_of_chosen_neighbours_is_counted():
    chosen = X < 225e-6  # the first five of twenty columns
    share = share_of_neighbours(PLACES, chosen, 24)
    column = np.rint(X / 50e-6).astype(int)
    inner = (Y > 150e-6) & (Y < 800e-6)
    assert (share[inner & (column == 1)] == 1.0).all()
    assert (share[column > 10] == 0.0).all()
    np.testing.assert_allclose(share[inner & (column == 5)], 10 / 24, atol=1 / 24)
    assert not share_of_neighbours(PLACES[:1], chosen[:1], 24).any()
    assert share_of_neighbours(PLACES[:3], np.array([True, False, False]), 24).tolist() == [0.0, 0.5, 0.5]
