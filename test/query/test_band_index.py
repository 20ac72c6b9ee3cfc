"""Bands by way of the index: the points of an exhaustive search, from no more blocks than can match."""

import gc
import itertools
import threading

import numpy as np
import pytest
import torch

from octn_ros.errors import QueryError
from octn_ros.field import (
    FieldDescription,
    HashGridConfig,
    InterpolatedField,
    NetworkConfig,
    NeuralField,
    NeuralFieldConfig,
    NeuralModel,
)
from octn_ros.query import BandQuery, Box, Sphere, find_band, find_band_exhaustively, polygon
from octn_ros.query.band_index import _INDICES, BLOCK, BandIndex
from octn_ros.volume import Volume, VolumeGeometry

SHAPES = [(17, 9, 23), (8, 16, 8), (3, 40, 5)]
SPACING, ORIGIN = (28e-6, 14.59e-6, 14e-6), (1e-3, -2e-3, 5e-4)


def volume_of(shape, seed=0):
    """Voxels that change slowly along the beam, so that some blocks can match and others cannot."""
    generator = np.random.default_rng(seed)
    ramp = np.linspace(0, 1, shape[1])[None, :, None]
    voxels = np.clip(ramp + 0.1 * generator.standard_normal(shape), 0, 1).astype(np.float32)
    return Volume(voxels, VolumeGeometry(shape, SPACING, ORIGIN), (0.0, 1.0), "log")


def neural(volume, backend="auto", seed=0):
    torch.manual_seed(seed)
    config = NeuralFieldConfig(HashGridConfig(levels=3, features=2, log2_table_size=10), NetworkConfig(1, 16))
    model = NeuralModel(config, volume.geometry.shape)
    with torch.no_grad():
        model.grid.table.uniform_(-1, 1)
        list(model.parameters())[-1].fill_(0.4)  # the output's bias
    return NeuralField(model, config, FieldDescription.of_volume(volume, "neural"), backend)


FIELDS = {
    "interpolated": InterpolatedField,
    "compiled": neural,
    "torch": lambda volume: neural(volume, "torch"),
}


def regions_of(shape):
    low, size = np.array(ORIGIN), np.array([shape[2] * SPACING[2], shape[0] * SPACING[0], shape[1] * SPACING[1]])
    centre, x, y = low + size / 2, low[0], low[1]
    ball = Sphere(tuple(centre), 0.4 * float(size.min()))
    box = Box(tuple(low + 0.2 * size), tuple(low + 0.7 * size))
    triangle = polygon([(x - 1e-6, y - 1e-6), (x + 0.9 * size[0], y), (x + 0.3 * size[0], y + size[1])])
    return {"all": None, "box": box, "ball": ball, "polygon": triangle, "rest": triangle & ~ball, "either": box | ball}


def assert_same(found, expected):
    np.testing.assert_array_equal(found.points_m, expected.points_m)
    np.testing.assert_array_equal(found.intensity, expected.intensity)
    assert found.searched == expected.searched
    assert found.description == expected.description


@pytest.mark.parametrize("kind", FIELDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_the_answer_is_the_exhaustive_one(kind, shape):
    field = FIELDS[kind](volume_of(shape))
    bands = [(0.0, 1.0), (0.2, 0.4), (0.41, 0.42), (0.6, 1.0)]
    seen = 0
    for region, (low, high), half_open in itertools.product(regions_of(shape).values(), bands, (False, True)):
        query = BandQuery(low, high, half_open)
        expected = find_band_exhaustively(field, query, region)
        assert_same(find_band(field, query, region), expected)
        seen += len(expected.points_m)
    assert seen > 1000


@pytest.mark.parametrize("half_open", [False, True])
def test_a_sample_on_a_limit_belongs_as_it_does_exhaustively(half_open):
    levels = np.linspace(0, 1, 9, dtype=np.float32)[np.arange(9 * 10 * 11).reshape(9, 10, 11) // 113]
    field = InterpolatedField(Volume.from_array(levels, (1e-5, 1e-5, 1e-5)))
    index = BandIndex.of(field)
    samples = index.samples((slice(0, 9), slice(0, 10), slice(0, 11)))
    for low, high in itertools.combinations(np.unique(samples).tolist(), 2):
        query = BandQuery(max(low, 0.0), min(high, 1.0), half_open)
        found = find_band(field, query)
        assert_same(found, find_band_exhaustively(field, query))
        assert len(found.points_m) == int(query.contains(samples).sum())


def test_blocks_that_cannot_match_are_told_by_their_extremes():
    field = InterpolatedField(volume_of((17, 40, 23)))
    whole = slice(0, 17), slice(0, 40), slice(0, 23)
    index = BandIndex.of(field)
    samples = index.samples(whole)
    matching = index.matching(whole, np.float32(0.8), np.float32(0.9), True)
    assert matching.shape == (3, 5, 3)
    assert 0 < matching.mean() < 0.7
    for block in np.ndindex(matching.shape):
        part = samples[tuple(slice(corner * BLOCK, (corner + 1) * BLOCK) for corner in block)]
        assert matching[block] == bool((part.max() >= 0.8) and (part.min() < 0.9))
    with pytest.raises(ValueError, match="read-only"):
        samples[0, 0, 0] = 1.0


class Counting(InterpolatedField):
    """A field that counts the points it is asked for."""

    asked = 0

    def lattice(self, lateral, axial, bscan):
        self.asked += len(lateral) * len(axial) * len(bscan)
        return super().lattice(lateral, axial, bscan)


def test_a_field_is_asked_once_and_only_where_a_region_lies():
    field = Counting(volume_of((64, 40, 48)))
    region = regions_of((64, 40, 48))["box"]
    first = find_band(field, BandQuery(0.2, 0.4), region)
    assert first.searched <= field.asked < 0.4 * 64 * 40 * 48
    asked = field.asked
    find_band(field, BandQuery(0.5, 0.9), region)
    assert field.asked == asked
    assert BandIndex.of(field).nbytes == pytest.approx(4 * asked, rel=0.05)
    whole = find_band(field, BandQuery(0.2, 0.4))
    assert_same(whole, find_band_exhaustively(InterpolatedField(field.volume), BandQuery(0.2, 0.4)))
    BandIndex.of(field).fill()
    assert BandIndex.of(field).nbytes == 64 * 40 * 48 * 4 + 8 * 5 * 6 * 8


def test_filling_in_slabs_leaves_no_seam(monkeypatch):
    monkeypatch.setattr("octn_ros.query.band_index.SLAB_POINTS", 1000)
    field = neural(volume_of((33, 20, 19)))
    shares = []
    assert_same(
        find_band(field, BandQuery(0.1, 0.9), progress=shares.append),
        find_band_exhaustively(field, BandQuery(0.1, 0.9)),
    )
    assert shares[-1] == 1.0


def test_samples_that_are_no_number_hide_no_others():
    class Holed(InterpolatedField):
        def lattice(self, lateral, axial, bscan):
            values = super().lattice(lateral, axial, bscan)
            values[:, ::2] = torch.nan
            return values

    field = Holed(volume_of((9, 16, 9)))
    found = find_band(field, BandQuery(0.3, 0.6))
    assert_same(found, find_band_exhaustively(field, BandQuery(0.3, 0.6)))
    assert len(found.points_m) > 50


def test_threads_share_one_index_and_agree():
    volume = volume_of((40, 24, 40))
    field = Counting(volume)
    regions = [region for region in regions_of((40, 24, 40)).values()] * 3
    answers = [None] * len(regions)

    def ask(number):
        answers[number] = find_band(field, BandQuery(0.3, 0.7), regions[number])

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(len(regions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    reference = InterpolatedField(volume)
    for answer, region in zip(answers, regions, strict=True):
        assert_same(answer, find_band_exhaustively(reference, BandQuery(0.3, 0.7), region))


def test_an_index_lives_as_long_as_its_field():
    field = InterpolatedField(volume_of((9, 9, 9)))
    index = BandIndex.of(field)
    assert BandIndex.of(field) is index
    find_band(field, BandQuery(0.2, 0.4))
    gc.collect()
    before = len(_INDICES)
    del field
    gc.collect()
    assert len(_INDICES) < before


def test_what_the_index_cannot_answer_is_searched_exhaustively(monkeypatch):
    volume = volume_of((9, 12, 9))
    field = InterpolatedField(volume)
    monkeypatch.setattr(BandIndex, "samples", lambda *given: pytest.fail("the index was asked"))
    query = BandQuery(0.3, 0.6, step_m=20e-6)
    assert_same(find_band(field, query), find_band_exhaustively(field, query))
    assert_same(find_band(volume, BandQuery(0.3, 0.6)), find_band_exhaustively(volume, BandQuery(0.3, 0.6)))
    monkeypatch.setattr("octn_ros.query.bands.LARGEST_INDEX", 9 * 12 * 9 - 1)
    assert len(find_band(field, BandQuery(0.3, 0.6)).points_m) > 10
    monkeypatch.setattr("octn_ros.query.bands.LARGEST_INDEX", 1 << 28)
    monkeypatch.setattr("octn_ros.query.bands.numba_is_there", lambda: False)
    assert len(find_band(field, BandQuery(0.3, 0.6)).points_m) > 10


def test_too_many_points_are_refused_before_they_are_listed():
    field = InterpolatedField(volume_of((9, 9, 9)))
    for search in (find_band, find_band_exhaustively):
        with pytest.raises(QueryError, match=r"at most 700 points, got 729 after 9 of 9 planes"):
            search(field, BandQuery(0.0, 1.0, max_points=700))
