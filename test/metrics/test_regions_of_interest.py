import json

import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.metrics import RegionOfInterest, air_and_tissue, find_regions, load_regions

ENTRIES = [
    {"name": "above", "kind": "air", "axial": [0, 4], "lateral": [1, 6]},
    {"name": "R1", "kind": "tissue", "axial": [5, 9], "lateral": [0, 2]},
]


def test_a_region_is_cut_and_knows_what_it_contains():
    region = RegionOfInterest("R", "tissue", (2, 4), (1, 4))
    image = np.arange(30).reshape(5, 6)
    np.testing.assert_array_equal(region.cut(image), [[13, 14, 15], [19, 20, 21]])
    inside = region.contains(np.array([1.9, 2.0, 3.0, 3.5]), np.array([2.0, 1.0, 3.0, 2.0]))
    np.testing.assert_array_equal(inside, [False, True, True, False])


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
def test_regions_are_read_from_files(tmp_path, suffix):
    path = tmp_path / f"regions{suffix}"
    path.write_text(json.dumps(ENTRIES))  # JSON is YAML too
    assert load_regions(path) == (
        RegionOfInterest("above", "air", (0, 4), (1, 6)),
        RegionOfInterest("R1", "tissue", (5, 9), (0, 2)),
    )


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{",
        "just words",
        json.dumps([{"name": "R", "kind": "tissue", "axial": [5, 9]}]),
        json.dumps([ENTRIES[0] | {"kind": "bone"}]),
        json.dumps([ENTRIES[0] | {"axial": [4, 4]}]),
        json.dumps([ENTRIES[0] | {"axial": [-1, 4]}]),
        json.dumps([ENTRIES[0] | {"axial": [0.5, 4]}]),
        json.dumps([ENTRIES[0] | {"axial": 3}]),
        json.dumps(["R"]),
    ],
)
def test_a_bad_file_is_named(tmp_path, content):
    path = tmp_path / "regions.yaml"
    path.write_text(content)
    with pytest.raises(QueryError, match=r"regions\.yaml: .*expected"):
        load_regions(path)


def test_a_missing_or_binary_file_is_named(tmp_path):
    with pytest.raises(QueryError, match="none"):
        load_regions(tmp_path / "none.json")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(QueryError, match="bytes"):
        load_regions(tmp_path / "bytes.json")


def test_a_region_outside_the_bscan_is_refused():
    with pytest.raises(QueryError, match="outside the B-scan"):
        RegionOfInterest("R", "air", (2, 6), (0, 3)).cut(np.zeros((5, 6)))


def test_regions_are_found_around_a_surface():
    air, tissue, boundary = find_regions(np.full(40, 50.0), (128, 40))
    # A margin of 6 voxels, an eighth of 128 = 16 voxels deep, the middle half of 40 columns.
    assert air == RegionOfInterest("air", "air", (28, 44), (10, 30))
    assert tissue == RegionOfInterest("tissue", "tissue", (56, 72), (10, 30))
    assert boundary == RegionOfInterest("boundary", "boundary", (44, 56), (10, 30))


def test_without_room_for_air_there_is_no_region_of_air():
    kinds = [region.kind for region in find_regions(np.full(40, 9.0), (128, 40))]
    assert kinds == ["tissue", "boundary"]


def test_one_stray_ascan_moves_no_region():
    surface = np.full(100, 50.0)
    surface[40] = 3.0
    assert find_regions(surface, (128, 100)) == find_regions(np.full(100, 50.0), (128, 100))


@pytest.mark.parametrize("surface", [np.full(39, 50.0), np.full(40, np.nan)])
def test_a_surface_that_does_not_fit(surface):
    with pytest.raises(QueryError, match="find_regions: expected"):
        find_regions(surface, (128, 40))


def test_air_and_tissue_follow_the_surface():
    # Bands of 11 voxels, 6 away from surfaces between rows 29 and 30, and 39 and 40.
    air, tissue = air_and_tissue(np.array([29.5, 39.5]), 80)
    for column, shift in ((0, 0), (1, 10)):
        assert np.flatnonzero(air[:, column]).tolist() == list(range(13 + shift, 24 + shift))
        assert np.flatnonzero(tissue[:, column]).tolist() == list(range(36 + shift, 47 + shift))
