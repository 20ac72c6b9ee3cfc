"""The kept field: whole or not at all, and never taken on trust."""

from __future__ import annotations

import dataclasses
import json
import os
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from octn_ros.errors import CheckpointError
from octn_ros.field import field_hash, load_field, volume_parts
from octn_ros.nodes.field_store import FieldStore, KeptField, store_path
from octn_ros.nodes.pose_history import StampedPose
from octn_ros.planning import from_translation_quaternion
from octn_ros.volume import Volume

STAMP_NS = 5_000_000_123
EE2BASE = from_translation_quaternion((0.1, 0.2, 0.3), (0.0, 0.6, 0.0, 0.8))


def kept_of(seed: int) -> KeptField:
    voxels = np.random.default_rng(seed).integers(0, 250, (5, 6, 7)).astype(np.uint8)
    volume = Volume.from_array(voxels, (28e-6, 14e-6, 14e-6), stamp_ns=STAMP_NS)
    data = b"".join(volume_parts(volume))
    pose = StampedPose(STAMP_NS - 7, EE2BASE, "base_link")
    return KeptField(data, field_hash(data), STAMP_NS, "oct_optical_frame", volume.normalized().max(axis=1), pose)


@pytest.fixture
def store(tmp_path: Path) -> FieldStore:
    return FieldStore(tmp_path / "deep" / "down" / "kept.field.zip")


def test_what_is_kept_comes_back_to_the_last_bit(store: FieldStore) -> None:
    assert store.load() is None
    given = kept_of(1)
    store.keep(given)
    found = store.load()
    assert found is not None
    assert (found.data, found.hash, found.stamp_ns, found.frame) == (
        given.data, given.hash, STAMP_NS, "oct_optical_frame",
    )  # fmt: skip
    np.testing.assert_array_equal(found.enface, given.enface)
    assert found.pose is not None
    assert (found.pose.stamp_ns, found.pose.frame) == (STAMP_NS - 7, "base_link")
    np.testing.assert_allclose(found.pose.ee2base, EE2BASE, atol=1e-15)


def test_a_clock_that_was_never_set_keeps_a_field_too(store: FieldStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: 100.0)  # of 1970, before what a zip archive can say
    store.keep(kept_of(1))
    found = store.load()
    assert found is not None
    assert found.data == kept_of(1).data


def test_a_field_that_no_archive_holds_is_refused_as_one(store: FieldStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def too_large(*_: object) -> None:
        raise ValueError("too large")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", too_large)
    with pytest.raises(CheckpointError, match="cannot keep the field: too large"):
        store.keep(kept_of(1))


def test_a_scan_without_a_pose_is_kept_without_one(store: FieldStore) -> None:
    store.keep(dataclasses.replace(kept_of(1), pose=None))
    found = store.load()
    assert found is not None
    assert found.pose is None


def test_only_the_newest_is_kept(store: FieldStore) -> None:
    for seed in range(3):
        store.keep(kept_of(seed))
    found = store.load()
    assert found is not None
    assert found.data == kept_of(2).data
    assert [path.name for path in store.path.parent.iterdir()] == [store.path.name]


def test_other_programs_can_read_the_field_inside(store: FieldStore, tmp_path: Path) -> None:
    store.keep(kept_of(1))
    with zipfile.ZipFile(store.path) as archive:
        archive.extractall(tmp_path / "out")
    assert load_field(tmp_path / "out" / "field.safetensors").description.stamp_ns == STAMP_NS
    assert np.load(tmp_path / "out" / "enface.npy").shape == (5, 7)


def test_a_field_cut_off_anywhere_is_damaged(store: FieldStore) -> None:
    store.keep(kept_of(1))
    whole = store.path.read_bytes()
    for length in [0, 1, *range(30, len(whole), 97), len(whole) - 1]:
        store.path.write_bytes(whole[:length])
        with pytest.raises(CheckpointError, match=r"kept.field.zip: the kept field is damaged"):
            store.load()


def test_a_flipped_bit_is_found_wherever_it_matters(store: FieldStore) -> None:
    store.keep(kept_of(1))
    whole = store.path.read_bytes()
    refused = 0
    for place in range(0, len(whole), 23):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        store.path.write_bytes(damaged)
        try:
            found = store.load()
        except CheckpointError:
            refused += 1
        else:
            # Dates and the like inside the archive mean nothing.
            assert found is not None
            assert (found.data, found.stamp_ns) == (kept_of(1).data, STAMP_NS)
    assert refused > len(whole) // 23 // 2


def rewritten(store: FieldStore, change: dict[str, object], compression: int = zipfile.ZIP_STORED) -> None:
    """Write the kept field again with values of its record changed."""
    store.keep(kept_of(1))
    with zipfile.ZipFile(store.path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts["kept.json"] = json.dumps(json.loads(parts["kept.json"]) | change).encode()
    with zipfile.ZipFile(store.path, "w", compression) as archive:
        for name, data in parts.items():
            archive.writestr(name, data)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"version": 2}, "expected version 1, got 2"),
        ({"hash": "0123456789abcdef"}, "expected a field of hash 0123456789abcdef"),
        ({"stamp_ns": 7}, "expected stamp, frame"),
        ({"stamp_ns": "today"}, "expected stamp, frame"),
        ({"frame": "camera_link"}, "camera_link"),
        ({"pose": {"stamp_ns": 1, "frame": "base_link", "ee2base": [[1, 2], [3, 4]]}}, "4x4"),
        ({"pose": [1, 2]}, "TypeError"),
    ],
)
def test_a_record_that_does_not_fit_the_field_is_refused(
    store: FieldStore, change: dict[str, object], reason: str
) -> None:
    rewritten(store, change)
    with pytest.raises(CheckpointError, match=reason):
        store.load()


def test_what_could_expand_is_refused(store: FieldStore) -> None:
    rewritten(store, {}, zipfile.ZIP_DEFLATED)
    with pytest.raises(CheckpointError, match="without compression"):
        store.load()


def test_a_field_that_cannot_be_kept_leaves_the_last_one(store: FieldStore, monkeypatch: pytest.MonkeyPatch) -> None:
    store.keep(kept_of(1))

    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", full)
    with pytest.raises(CheckpointError, match="cannot keep the field: No space left on device"):
        store.keep(kept_of(2))
    found = store.load()
    assert found is not None
    assert found.data == kept_of(1).data
    assert len(list(store.path.parent.iterdir())) == 1


def test_nobody_else_may_read_it(store: FieldStore) -> None:
    store.keep(kept_of(1))
    assert store.path.stat().st_mode & 0o777 == 0o600


def test_what_a_killed_process_left_behind_is_cleared_away(store: FieldStore, monkeypatch: pytest.MonkeyPatch) -> None:
    store.clear_leftovers()  # of a folder that is not there yet
    store.keep(kept_of(1))
    other = store.path.with_name(".settings")
    other.touch()
    monkeypatch.setattr(Path, "unlink", lambda path, missing_ok=False: None)  # as if killed before it is tidied up
    monkeypatch.setattr(os, "fsync", lambda file: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        store.keep(kept_of(2))
    monkeypatch.undo()
    assert len(list(store.path.parent.iterdir())) == 3
    store.clear_leftovers()
    assert sorted(path.name for path in store.path.parent.iterdir()) == sorted([other.name, store.path.name])
    found = store.load()
    assert found is not None
    assert found.data == kept_of(1).data


def test_a_folder_in_its_place_is_an_error_both_ways(tmp_path: Path) -> None:
    store = FieldStore(tmp_path)
    with pytest.raises(CheckpointError, match="cannot read"):
        store.load()
    with pytest.raises(CheckpointError, match="cannot keep"):
        store.keep(kept_of(1))


def test_where_it_lies(monkeypatch: pytest.MonkeyPatch) -> None:
    assert store_path("", "/octn/trainer") is None
    assert store_path("/data/kept.zip", "/octn/trainer") == Path("/data/kept.zip")
    monkeypatch.setenv("HOME", "/home/surgeon")
    assert store_path("~/kept.zip", "/octn/trainer") == Path("/home/surgeon/kept.zip")
    monkeypatch.setenv("ROS_HOME", "/var/ros")
    assert store_path("auto", "/octn/trainer") == Path("/var/ros/octn_ros/octn.trainer.field.zip")
    assert store_path("auto", "/theatre_2/trainer") == Path("/var/ros/octn_ros/theatre_2.trainer.field.zip")
    monkeypatch.delenv("ROS_HOME")
    assert store_path("auto", "/octn/trainer") == Path("/home/surgeon/.ros/octn_ros/octn.trainer.field.zip")
