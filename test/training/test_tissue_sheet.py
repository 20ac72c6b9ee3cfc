"""The sheet that tissue follows: found where it is, interpolated without overshoot, wrong as it is between B-scans."""

import dataclasses

import numpy as np
import pytest

from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.training.tissue_sheet import TissueSheet
from octn_ros.volume import Volume


def never():
    return False


def volume_with(depth, axials=64, noise=0.0):
    """Dark above a surface at `depth` [bscan, lateral], brighter below it."""
    below = np.arange(axials)[None, :, None] - depth[:, None, :]
    intensity = 0.2 + 0.5 / (1.0 + np.exp(-2.0 * below))
    intensity += noise * np.random.default_rng(0).standard_normal(intensity.shape)
    return Volume.from_array(np.float32(intensity.clip(0, 1)), (2e-5, 1e-5, 1e-5), intensity_range=(0.0, 1.0))


def test_a_tilted_plane_is_found_between_voxels():
    """To a tenth of a voxel, away from the lateral borders."""
    bscan, lateral = np.meshgrid(np.arange(5), np.arange(40), indexing="ij")
    depth = 20.3 + 0.7 * bscan + 0.2 * lateral
    found = TissueSheet.of(volume_with(depth), never).depth
    np.testing.assert_allclose(found[:, 5:-5], depth[:, 5:-5], atol=0.1)


def test_a_step_is_found_as_a_step():
    """The whole of it within the Gaussian's width, none of it smeared over the rest."""
    depth = np.where(np.arange(60) < 30, 20.0, 32.0)[None, :].repeat(4, axis=0)
    found = TissueSheet.of(volume_with(depth), never).depth
    np.testing.assert_allclose(
        np.delete(found, slice(26, 34), axis=1), np.delete(depth, slice(26, 34), axis=1), atol=0.2
    )


def test_it_is_found_under_speckle():
    """On a phantom of single looks nine A-scans of ten are within two voxels of the true surface."""
    phantom = make_phantom(named_phantom("wavy-13dB-single-look", shape=(9, 160, 96)))
    found = TissueSheet.of(phantom.volume, never).depth
    true = TissueSheet.of(phantom.truth, never).depth
    assert np.quantile(np.abs(found - true), 0.9) < 2.0


def test_the_path_is_the_cheapest_of_all():
    """Against every path there is, on a scan small enough to try them all."""
    from itertools import product

    from octn_ros.training.tissue_sheet import _PRICE_PER_VOXEL, _cheapest_path

    cost = np.float32(-np.random.default_rng(0).random((5, 3, 6)))  # [lateral, bscan, axial]
    found = _cheapest_path(cost)

    def price(bscan, path):
        steps = _PRICE_PER_VOXEL * np.abs(np.diff(path)).sum()
        return sum(cost[lateral, bscan, row] for lateral, row in enumerate(path)) + steps

    for bscan in range(3):
        best = min(price(bscan, path) for path in product(range(6), repeat=5))
        assert price(bscan, found[:, bscan]) == pytest.approx(best, abs=1e-5)


def test_between_bscans_it_is_smooth_and_does_not_overshoot():
    """A slope is met between B-scans, a step overshoots neither side, and beyond the ends it is held."""
    slope = TissueSheet(np.arange(8.0)[:, None] * np.array([[1.0, 2.0]]))
    np.testing.assert_allclose(slope.at(np.array([2.25, -3.0, 99.0])), [[2.25, 4.5], [0.0, 0.0], [7.0, 14.0]])
    step = TissueSheet(np.repeat([[10.0], [30.0]], 5, axis=0))
    between = step.at(np.linspace(0, 9, 91))
    assert between.min() > 9.999
    assert between.max() < 30.001


def test_cells_follow_the_movement():
    """About a voxel of movement in each cell, not less than asked for, and not without end."""

    def sheet(step):
        return TissueSheet(step * np.arange(6.0)[:, None].repeat(10, axis=1))

    assert [sheet(step).cells_per_bscan(1.0, 64) for step in (0.0, 1.2, 3.9, 100.0)] == [1.0, 1.0, 4.0, 8.0]
    assert sheet(0.0).cells_per_bscan(2.0, 64) == 2.0
    assert sheet(100.0).cells_per_bscan(1.0, 2**26 // (60 * 3)) == 3.0  # memory for three


def test_what_is_smooth_loses_more_at_half_the_distance():
    """A parabola's errors shrink most, a random walk's by half; nothing is taken to be rougher than that."""
    bscan = np.arange(200.0)[:, None]
    generator = np.random.default_rng(0)
    smooth = TissueSheet((0.1 * (bscan - 100.0) ** 2).repeat(50, axis=1))
    rough = TissueSheet(generator.standard_normal((200, 50)))
    walk = TissueSheet(rough.depth.cumsum(axis=0))
    assert smooth.share_at_half_distance == pytest.approx(1 / 16)
    assert walk.share_at_half_distance == pytest.approx(0.48, abs=0.03)
    assert rough.share_at_half_distance == 0.5
    assert TissueSheet(rough.depth[:4]).share_at_half_distance == 0.5
    flat = TissueSheet(np.full((9, 5), 7.0))
    assert flat.share_at_half_distance == 0.5


def test_as_if_between_takes_part_of_an_error_and_the_whole_of_a_leap():
    """On a slope there is none; one A-scan that leaps is as far off as when it is not measured at all."""
    depth = (2.0 * np.arange(9.0)[:, None]).repeat(20, axis=1)
    neighbours = [1, 3, 5, 7]
    np.testing.assert_allclose(TissueSheet(depth).as_if_between(4, neighbours), depth[4], atol=1e-12)
    bent = depth + 0.1 * np.random.default_rng(0).standard_normal(depth.shape)
    bent[4, 7] += 40.0
    sheet = TissueSheet(bent)
    guessed = TissueSheet(bent[neighbours]).at(np.array([1.5]))[0]
    answer = sheet.as_if_between(4, neighbours)
    assert answer[7] == pytest.approx(guessed[7])
    others = np.delete(np.arange(20), 7)
    share = (answer - bent[4])[others] / (guessed - bent[4])[others]
    np.testing.assert_allclose(np.median(share), sheet.share_at_half_distance)


def test_a_scan_in_several_slabs_gives_the_same_sheet(monkeypatch):
    """B-scans are looked at one by one, whatever the memory."""
    phantom = make_phantom(dataclasses.replace(named_phantom("wavy-13dB-averaged"), shape=(7, 48, 40)))
    whole = TissueSheet.of(phantom.volume, never).depth
    monkeypatch.setattr("octn_ros.training.tissue_sheet._SLAB_VOXELS", 2 * 48 * 40)
    np.testing.assert_array_equal(TissueSheet.of(phantom.volume, never).depth, whole)


def test_a_scan_without_anything_to_follow_has_some_sheet():
    """Black B-scans: no division by nothing, a depth within the A-scan."""
    black = np.zeros((3, 64, 12), np.uint8)
    black[0, 30:] = 200
    depth = TissueSheet.of(Volume.from_array(black, (2e-5, 1e-5, 1e-5)), never).depth
    assert np.isfinite(depth).all()
    assert 0 <= depth.min() <= depth.max() <= 63
