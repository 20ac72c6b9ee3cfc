import dataclasses
import tracemalloc

import numpy as np
import pytest

from octn_ros.errors import VolumeError
from octn_ros.simulation import PhantomConfig, Scanner, make_phantom
from octn_ros.volume.assembly import CScanAssembler
from octn_ros.volume.bscan_places import IMAGE2OCT_ROTATION
from octn_ros.volume.subsampling import subsample_bscans
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


def test_the_voxels_lie_where_whoever_uses_them_wants_them(bscans, volume):
    rooms = []

    def room(shape, dtype):
        rooms.append(np.empty(shape, dtype))
        return rooms[-1]

    assembler = CScanAssembler(COUNT, volume.geometry.spacing_m, room=room)
    for _ in range(2):
        assembled = [assembler.add(b.image, b.image2oct, b.stamp_ns) for b in bscans][-1]
        assert np.shares_memory(assembled.array, rooms[-1])
        np.testing.assert_array_equal(assembled.array, volume.array)
    assert len(rooms) == 2


def test_one_assembler_serves_scan_after_scan(assembler, bscans, volume):
    results = [result for result in feed(assembler, bscans * 3) if result is not None]
    assert len(results) == 3
    assert results[0].array is not results[1].array
    assert assembler.received == 0


@pytest.fixture
def following(volume):
    """An assembler that is not told how far B-scans lie apart."""
    _, axial_m, lateral_m = volume.geometry.spacing_m
    return CScanAssembler(COUNT, (None, axial_m, lateral_m))


def test_the_step_comes_from_the_poses_where_it_is_not_stated(following, bscans, volume):
    result = feed(following, bscans)[-1]
    np.testing.assert_array_equal(result.array, volume.array)
    assert result.geometry == volume.geometry


def test_the_poses_tell_the_step_of_a_subsampled_scan(following, volume):
    dense = make_phantom(PhantomConfig(shape=(4 * COUNT, 20, 12))).volume
    sparse = subsample_bscans(dense, 4).volume
    kept = list(Scanner(dense).bscans(0, 10))[::4]
    result = feed(following, kept)[-1]
    assert result.geometry == sparse.geometry
    np.testing.assert_array_equal(result.array, sparse.array)
    stated = CScanAssembler(COUNT, dense.geometry.spacing_m)
    with pytest.raises(VolumeError, match="missing: 1 to 3"):
        feed(stated, kept)


def test_every_scan_tells_its_own_step(following, bscans):
    steps = [1.0, 1.5, 0.25]
    scans = [[moved(s, y=(factor - 1.0) * s.image2oct[1, 3]) for s in bscans] for factor in steps]
    results = [feed(following, scan)[-1].geometry.spacing_m[0] for scan in scans]
    np.testing.assert_allclose(results, [28e-6 * factor for factor in steps], rtol=1e-9)


def test_poses_that_jitter_give_their_mean_step(volume):
    count, jitter = 200, 0.02
    generator = np.random.default_rng(3)
    images = generator.integers(0, 255, (count, 4, 5), dtype=np.uint8)
    wide = Volume.from_array(images, volume.geometry.spacing_m)
    scans = list(Scanner(wide).bscans(0, 1))
    noisy = [moved(s, y=28e-6 * jitter * generator.uniform(-1, 1)) if s.index else s for s in scans]
    result = feed(CScanAssembler(count, (None, *volume.geometry.spacing_m[1:])), noisy)[-1]
    assert abs(result.geometry.spacing_m[0] - 28e-6) <= 28e-6 * jitter / (count - 1)
    np.testing.assert_array_equal(result.array, images)


FOLLOWING_FAULTS = {
    "first dropped": (lambda s: s[1:], "expected B-scan 0, which begins a C-scan, at y = 0, got one at y = 28 um"),
    "second dropped": (lambda s: [s[0], *s[2:]], "between the indices 1 and 2; missing: 1, if B-scans lie 28 um"),
    "two dropped": (lambda s: [s[0], *s[3:]], "missing: 1 to 2, if B-scans lie 28 um apart"),
    "dropped later": (lambda s: [*s[:3], *s[4:]], "expected B-scan 3 of 6, got B-scan 4; missing: 3"),
    "repeated": (lambda s: [*s[:2], s[1], *s[2:]], "expected B-scan 2 of 6, got B-scan 1 again"),
    "uneven": (lambda s: [*s[:3], moved(s[3], y=10e-6), *s[4:]], "got one at y = 94 um, between the indices 3 and 4"),
    "backwards": (lambda s: [s[0], moved(s[1], y=-80e-6)], "expected B-scan 1 beyond y = 0, got one at y = -52 um"),
}


@pytest.mark.parametrize("fault", FOLLOWING_FAULTS)
def test_faults_are_found_without_a_stated_step(following, bscans, volume, fault):
    spoil, message = FOLLOWING_FAULTS[fault]
    with pytest.raises(VolumeError, match=message):
        feed(following, spoil(bscans))
    assert following.received == 0
    np.testing.assert_array_equal(feed(following, bscans)[-1].array, volume.array)


@pytest.mark.parametrize("dropped", range(COUNT))
@pytest.mark.parametrize("stated", [True, False])
def test_no_scan_with_a_dropped_bscan_is_ever_complete(following, assembler, bscans, dropped, stated):
    used, errors = assembler if stated else following, []
    for scan in [*bscans[:dropped], *bscans[dropped + 1 :], bscans[0]]:
        try:
            assert used.add(scan.image, scan.image2oct, scan.stamp_ns) is None
        except VolumeError as error:
            errors.append(str(error))
    assert len(errors) == 1
    number = 0 if dropped == 0 else dropped
    assert f"missing: {number}" in errors[0] or f"expected B-scan {number}" in errors[0]


def test_images_sent_in_another_form_are_alien(assembler, bscans):
    for scan in bscans[:2]:
        assembler.add(scan.image, scan.image2oct, scan.stamp_ns, "probe")
    with pytest.raises(VolumeError, match=r"B-scan 2: expected .* \(probe\), got one camera"):
        assembler.add(bscans[2].image, bscans[2].image2oct, bscans[2].stamp_ns, "camera")


def test_a_scan_of_too_many_voxels_is_refused_at_its_first_bscan(bscans, volume):
    voxels = volume.array.size
    tight = CScanAssembler(COUNT, volume.geometry.spacing_m, largest_voxels=voxels - 1)
    for _ in range(2):
        with pytest.raises(VolumeError, match=f"at most {voxels - 1:,} voxels, got the first of 6 x 60 x 20"):
            tight.add(bscans[0].image, bscans[0].image2oct, 0)
        assert feed(tight, bscans[1:]) == [None] * (COUNT - 1), "the rest of it is left aside"
    roomy = CScanAssembler(COUNT, volume.geometry.spacing_m, largest_voxels=voxels)
    assert feed(roomy, bscans)[-1] is not None


def test_a_scan_that_ends_early_is_given_up_with_what_is_missing(assembler, bscans, volume):
    assert assembler.give_up() is None
    feed(assembler, bscans[:-1])
    assert assembler.give_up() == "expected B-scan 5 of 6, none came; missing: 5"
    feed(assembler, bscans[:2])
    assert assembler.give_up() == "expected B-scan 2 of 6, none came; missing: 2 to 5"
    assert assembler.give_up() is None
    with pytest.raises(VolumeError, match="got B-scan 5; waiting for a B-scan 0"):
        feed(assembler, bscans[-1:])
    np.testing.assert_array_equal(feed(assembler, bscans)[-1].array, volume.array)


def test_a_scan_of_67_million_voxels_is_assembled_in_one_copy_of_it():
    """256 images of 512 x 512: what is allocated in all stays below half a C-scan beyond the C-scan itself."""
    image = np.arange(512 * 512, dtype=np.uint32).astype(np.uint8).reshape(512, 512)
    pose = np.eye(4)
    pose[:3, :3] = IMAGE2OCT_ROTATION
    tracemalloc.start()
    try:
        assembler, result = CScanAssembler(256, (None, 4e-6, 10e-6)), None
        for index in range(256):
            pose[1, 3] = index * 10e-6
            result = assembler.add(image, pose, index)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert result.array.size == 1 << 26
    assert peak < 1.5 * result.array.nbytes
    assert (result.array[::51] == image).all()


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


@pytest.mark.parametrize("lost_from", range(1, COUNT))
def test_the_end_of_one_scan_is_not_completed_by_the_next(assembler, volume, bscans, lost_from):
    later = list(Scanner(volume).bscans(5_000 + COUNT * 100, 100))
    with pytest.raises(VolumeError, match=f"^B-scan {lost_from}: expected a stamp nearer to .* of two C-scans"):
        feed(assembler, [*bscans[:lost_from], *later[lost_from:]])
    np.testing.assert_array_equal(feed(assembler, later)[-1].array, volume.array)


@pytest.mark.parametrize("count", range(2, 7))
def test_a_pace_that_jitters_is_told_from_two_scans_however_few_the_bscans(volume, count):
    generator = np.random.default_rng(count)
    few = list(Scanner(volume).bscans(0, 1))[:count]
    assembler, step_ns = CScanAssembler(count, volume.geometry.spacing_m), 10_000_000

    def scan(missed=0, lost_from=0):
        stamps = np.arange(count) * step_ns + generator.integers(-500_000, 500_000, count)
        stamps[lost_from:] += missed * count * step_ns
        return feed(assembler, [dataclasses.replace(s, stamp_ns=int(ns)) for s, ns in zip(few, stamps, strict=True)])

    for _ in range(50):
        assert scan()[-1] is not None
    for lost_from in range(1, count if count > 2 else 0):  # of two B-scans nobody knows the pace
        with pytest.raises(VolumeError, match="of two C-scans"):
            scan(1, lost_from)


def test_a_scanner_that_keeps_no_even_pace_is_heard(assembler, bscans, volume):
    steps = np.array([0, 100, 40, 170, 400, 100])
    uneven = [dataclasses.replace(scan, stamp_ns=int(ns)) for scan, ns in zip(bscans, steps.cumsum(), strict=True)]
    np.testing.assert_array_equal(feed(assembler, uneven)[-1].array, volume.array)
