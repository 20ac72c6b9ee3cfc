import dataclasses

import numpy as np
import pytest

from octn_ros.errors import VolumeError
from octn_ros.simulation import PhantomConfig, Scanner, make_phantom
from octn_ros.volume.assembly import CScanAssembler
from octn_ros.volume.volume import Volume

COUNT = 6


@pytest.fixture(scope="module")
def volume():
    return make_phantom(PhantomConfig(shape=(COUNT, 60, 20))).volume


@pytest.fixture
def bscans(volume):
    return list(Scanner(volume).bscans(5_000, 100))


@pytest.fixture
def assembler(volume):
    return CScanAssembler(COUNT, volume.geometry.spacing_m, "log")


def feed(assembler, bscans):
    return [assembler.add(scan.image, scan.image2oct, scan.stamp_ns) for scan in bscans]


def moved(scan, x=0.0, y=0.0, z=0.0):
    pose = scan.image2oct.copy()
    pose[:3, 3] += (x, y, z)
    return dataclasses.replace(scan, image2oct=pose)


def test_reassembled_volume_equals_the_scanned_one_bit_for_bit(assembler, bscans, volume):
    *early, last = feed(assembler, bscans)
    assert early == [None] * (COUNT - 1)
    np.testing.assert_array_equal(last.array, volume.array)
    assert last.array.dtype == volume.array.dtype
    assert (last.geometry, last.intensity_range, last.intensity_scale) == (volume.geometry, (0.0, 255.0), "log")
    assert last.stamp_ns == 5_000


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_other_voxel_types_survive(dtype):
    array = np.random.default_rng(0).integers(0, 60_000, (COUNT, 7, 9)).astype(dtype)
    volume = Volume.from_array(array, (28e-6, 14.59e-6, 14e-6))
    result = feed(CScanAssembler(COUNT, volume.geometry.spacing_m), Scanner(volume).bscans(0, 1))[-1]
    np.testing.assert_array_equal(result.array, array)
    assert result.array.dtype == dtype


def test_origin_comes_from_the_first_pose(assembler, bscans):
    result = feed(assembler, [moved(scan, x=1e-3, z=2e-3) for scan in bscans])[-1]
    np.testing.assert_allclose(result.geometry.origin_m, (1e-3, 0.0, 2e-3))


def test_poses_of_single_precision_are_near_enough(assembler, bscans, volume):
    rounded = [dataclasses.replace(s, image2oct=s.image2oct.astype(np.float32)) for s in bscans]
    np.testing.assert_array_equal(feed(assembler, rounded)[-1].array, volume.array)


def test_images_are_copied(assembler, bscans, volume):
    buffer = bscans[0].image.copy()
    for scan in bscans:
        buffer[:] = scan.image
        result = assembler.add(buffer, scan.image2oct, scan.stamp_ns)
    np.testing.assert_array_equal(result.array, volume.array)


def test_one_assembler_serves_scan_after_scan(assembler, bscans, volume):
    results = [result for result in feed(assembler, bscans * 3) if result is not None]
    assert len(results) == 3
    assert results[0].array is not results[1].array
    assert assembler.received == 0


FAULTS = {
    "repeated": (lambda s: [*s[:3], s[2], *s[3:]], "expected B-scan 3 of 6, got B-scan 2 again"),
    "dropped": (lambda s: [*s[:2], *s[3:]], "expected B-scan 2 of 6, got B-scan 3; missing: 2"),
    "several dropped": (lambda s: [*s[:2], *s[4:]], "got B-scan 4; missing: 2 to 3"),
    "late": (lambda s: [*s[:3], s[1], *s[3:]], "got B-scan 1 again"),
    "size": (
        lambda s: [*s[:2], dataclasses.replace(s[2], image=s[2].image[:-1]), *s[3:]],
        r"B-scan 2: expected \(60, 20\) of uint8",
    ),
    "type": (
        lambda s: [*s[:2], dataclasses.replace(s[2], image=s[2].image.astype(np.uint16)), *s[3:]],
        "B-scan 2: expected .* got .* of uint16",
    ),
    "step": (lambda s: [s[0], *(moved(scan, y=0.5 * 28e-6) for scan in s[1:])], "between the indices 1 and 2"),
    "sideways": (lambda s: [*s[:4], moved(s[4], x=5e-6), s[5]], "B-scan 4: .* 5.00 um laterally"),
    "axial": (lambda s: [*s[:4], moved(s[4], z=-5e-6), s[5]], "B-scan 4: .* -5.00 um axially"),
    "alien": (lambda s: [*s[:3], moved(s[3], y=36 * 28e-6), *s[4:]], "expected B-scan indices 0 to 5, got 39"),
    "older": (lambda s: [*s[:3], dataclasses.replace(s[3], stamp_ns=10), *s[4:]], "B-scan 3: expected a stamp of"),
    "no pose": (
        lambda s: [*s[:3], dataclasses.replace(s[3], image2oct=np.full((4, 4), np.nan)), *s[4:]],
        "expected a finite 4x4 pose",
    ),
    "mirrored": (
        lambda s: [*s[:3], dataclasses.replace(s[3], image2oct=s[3].image2oct @ np.diag([-1, 1, -1, 1])), *s[4:]],
        "B-scan 3: expected image axes",
    ),
    "joined late": (lambda s: s[2:], "expected B-scan 0, which begins a C-scan, got B-scan 2"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_reported_once_drops_the_scan_and_spares_the_next(assembler, bscans, volume, fault):
    spoil, message = FAULTS[fault]
    errors, results = [], []
    for scan in spoil(bscans):
        try:
            results.append(assembler.add(scan.image, scan.image2oct, scan.stamp_ns))
        except VolumeError as error:
            errors.append(error)
    assert set(results) <= {None}
    assert len(errors) == 1
    with pytest.raises(VolumeError, match=message):
        raise errors[0]
    assert assembler.received == 0
    np.testing.assert_array_equal(feed(assembler, bscans)[-1].array, volume.array)


def test_a_new_scan_interrupts_the_old_one_and_is_kept(assembler, bscans, volume):
    feed(assembler, bscans[:4])
    with pytest.raises(VolumeError, match="C-scan of 4 B-scans is dropped and a new one has begun"):
        feed(assembler, bscans[:1])
    np.testing.assert_array_equal(feed(assembler, bscans[1:])[-1].array, volume.array)


@pytest.mark.parametrize("image", [np.zeros(5, np.uint8), np.zeros((1, 9), np.uint8), np.zeros((5, 5), np.int64)])
def test_a_first_image_of_no_use_is_refused_every_time(assembler, bscans, image):
    for _ in range(2):
        with pytest.raises(VolumeError, match="B-scan 0: expected an image"):
            assembler.add(image, bscans[0].image2oct, 0)


@pytest.mark.parametrize(("value", "message"), [(np.nan, "finite"), (1.0, "constant")])
def test_a_complete_scan_without_usable_voxels_is_refused(bscans, volume, value, message):
    assembler = CScanAssembler(COUNT, volume.geometry.spacing_m)
    blank = [dataclasses.replace(s, image=np.full((4, 4), value, np.float32)) for s in bscans]
    with pytest.raises(VolumeError, match=message):
        feed(assembler, blank)
    assert feed(assembler, bscans)[-1] is not None


@pytest.mark.parametrize(("count", "spacing"), [(1, (28e-6, 14e-6, 14e-6)), (4, (0.0, 14e-6, 14e-6))])
def test_impossible_scans_are_refused(count, spacing):
    with pytest.raises(VolumeError, match="expected"):
        CScanAssembler(count, spacing)
