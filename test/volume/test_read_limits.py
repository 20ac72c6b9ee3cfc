"""How much memory reading takes, and what is refused before it is taken."""

import tracemalloc
import zlib

import nibabel
import numpy as np
import pytest

from octn_ros.errors import VolumeError
from octn_ros.volume import Volume, load_volume, save_volume
from octn_ros.volume.limits import DEFAULT_MAX_BYTES, ReadLimit, check_deflated

SPACING_UM = (28.0, 14.0, 14.0)
MIB = 2**20


@pytest.mark.parametrize(
    ("name", "dtype"), [("scan.nii", np.uint16), ("scan.nii", np.int16), ("scan.nii.gz", np.uint8)]
)
def test_there_is_never_a_second_copy_of_a_nifti(tmp_path, monkeypatch, name, dtype):
    monkeypatch.setattr("octn_ros.volume.slabs._SLAB_BYTES", 2**19)
    monkeypatch.setattr("octn_ros.volume.slabs._READ_BYTES", 2**18)
    whole = np.tile(np.random.default_rng(0).integers(0, 200, (64, 128, 64)).astype(dtype), (1, 1, 16))
    nibabel.save(nibabel.Nifti1Image(whole, np.eye(4)), tmp_path / name)
    load_volume(tmp_path / name, SPACING_UM)  # imports are not counted
    tracemalloc.start()
    try:
        volume = load_volume(tmp_path / name, SPACING_UM)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(volume.array, whole)
    assert peak < volume.array.nbytes + 3 * MIB  # the array has 8 MiB at least; a slab, and small things


def test_a_limit_in_bytes_is_kept(tmp_path):
    np.save(tmp_path / "scan.npy", np.arange(6000, dtype=np.int16).reshape(10, 20, 30))
    load_volume(tmp_path / "scan.npy", SPACING_UM, max_bytes=24_000)  # 6,000 voxels that become single floats
    with pytest.raises(VolumeError, match="expected at most 23,999 bytes of voxels, the header claims 24,000"):
        load_volume(tmp_path / "scan.npy", SPACING_UM, max_bytes=23_999)


@pytest.mark.parametrize("name", ["scan.npy", "scan.npz", "scan.nii", "scan.tif"])
def test_a_limit_in_voxels_is_kept_before_anything_is_read(tmp_path, name):
    array = np.arange(6000, dtype=np.uint8).reshape(10, 20, 30)
    if name == "scan.npy":
        np.save(tmp_path / name, array)
    else:
        save_volume(tmp_path / name, Volume.from_array(array, (28e-6, 14e-6, 14e-6)))
    assert load_volume(tmp_path / name, SPACING_UM, max_voxels=6000).array.size == 6000
    with pytest.raises(VolumeError, match=r"at most 5,999 voxels, the header claims .* = 6,000"):
        load_volume(tmp_path / name, SPACING_UM, max_voxels=5999)


@pytest.mark.parametrize(
    ("claimed", "stored", "compressed", "allowed"),
    [
        (1000, 999, False, False),  # shorter than it claims
        (1000, 1000, False, True),
        (256 * MIB, 10, True, True),  # compressed data may always take 256 MiB
        (256 * MIB + 1, 10, True, False),
        (1000 * MIB, 10 * MIB, True, True),  # and a hundred times its size
        (1000 * MIB + 1, 10 * MIB, True, False),
        (DEFAULT_MAX_BYTES, DEFAULT_MAX_BYTES, False, True),
        (DEFAULT_MAX_BYTES + 1, DEFAULT_MAX_BYTES + 1, False, False),
    ],
)
def test_claims_are_held_against_the_size_of_the_file(claimed, stored, compressed, allowed):
    if allowed:
        ReadLimit().check(claimed, stored, compressed=compressed)
    else:
        with pytest.raises(VolumeError, match="claims"):
            ReadLimit().check(claimed, stored, compressed=compressed)


def test_a_limit_of_ones_own_replaces_all_others():
    ReadLimit(2 * DEFAULT_MAX_BYTES).check(2 * DEFAULT_MAX_BYTES, 1, compressed=True)


def test_a_segment_that_expands_too_far_is_refused(monkeypatch):
    monkeypatch.setattr("octn_ros.volume.limits._HARMLESS_BYTES", MIB)
    bomb = zlib.compress(bytes(4 * MIB))
    with pytest.raises(VolumeError, match="in a compressed segment"):
        check_deflated(bomb, 3 * MIB)
    check_deflated(bomb, 4 * MIB)
    check_deflated(bomb[:1000], 0)  # too short to do harm
