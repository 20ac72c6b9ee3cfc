"""C-scans from the scanner's topics: what fits together is fitted, what does not is reported with its index."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from octn_ros.field import loads_field
from octn_ros.nodes import conversions, qos, status
from octn_ros.planning import from_translation_quaternion
from octn_ros.simulation import BScan, Scanner
from octn_ros.volume import Volume, subsample_bscans

COUNT = 6
SPACING_UM = [28.0, 14.59, 14.0]
OF_SCANNER = {"bscan_count": COUNT, "spacing_um": SPACING_UM}
FOLLOWING = {"bscan_count": COUNT, "spacing_um": [0.0, 14.59, 14.0]}
STAMP_NS = 5_000_000_000
LAST_NS = STAMP_NS + (COUNT - 1) * 1_000_000
BASE = "base_link"


def bscans(volume: Volume) -> list[BScan]:
    return list(Scanner(volume).bscans(STAMP_NS, 1_000_000))


def field_of(bench: Any) -> Any:
    """Return the first field of the graph, that through the voxels."""
    return loads_field(conversions.field_data(bench.field.wait(bench.timeout_s)))


def publish_pose(bench: Any, stamp_ns: int, x_m: float = 0.0, angle_rad: float = 0.0) -> None:
    turn = (0.0, 0.0, np.sin(angle_rad / 2), np.cos(angle_rad / 2))
    pose = from_translation_quaternion((x_m, 0.0, 0.0), turn)
    bench.ee_pose.publish(conversions.matrix_to_pose_stamped(pose, stamp_ns, BASE))


# --- what the images and their poses say


def test_the_step_comes_from_the_poses(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**FOLLOWING)
    bench.scan(volume, STAMP_NS)
    field = field_of(bench)
    assert field.geometry == volume.geometry
    np.testing.assert_array_equal(field.volume.array, volume.array)


def test_a_subsampled_scan_has_the_step_of_its_poses(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**(FOLLOWING | {"bscan_count": 3}))
    for bscan in bscans(volume)[::2]:
        bench.send(bscan)
    field = field_of(bench)
    sparse = subsample_bscans(volume, 2).volume
    assert field.geometry == sparse.geometry
    np.testing.assert_array_equal(field.volume.array, sparse.array)


def test_a_stated_step_is_held_against_the_poses(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**(OF_SCANNER | {"bscan_count": 3}))
    for bscan in bscans(volume)[::2]:
        bench.send(bscan)
    bench.until(
        "C-scan dropped: expected B-scan 1 of 3, got B-scan 2; missing: 1",
        "or B-scans lie 56 um apart and not the 28 um that are stated (spacing_um)",
    )
    assert not bench.field.messages


def test_a_scanner_that_sends_more_than_stated_is_told_of(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**(OF_SCANNER | {"bscan_count": COUNT - 2}))
    bench.scan(volume, STAMP_NS)
    bench.until(f"got {COUNT - 2} (y = 112 um)", f"more than the {COUNT - 2} that are stated (bscan_count)")


@pytest.mark.parametrize("parameters", [OF_SCANNER, FOLLOWING], ids=["stated", "from poses"])
@pytest.mark.parametrize("dropped", range(COUNT - 1))
def test_a_dropped_bscan_is_reported_with_its_index(
    trainer_bench: Callable[..., Any], volume: Volume, dropped: int, parameters: dict[str, Any]
) -> None:
    bench = trainer_bench(**parameters)
    bench.scan(volume, STAMP_NS, skip=dropped)
    bench.until("C-scan dropped", "B-scan 0, which begins" if dropped == 0 else f"missing: {dropped}")
    assert not bench.field.messages
    bench.scan(volume, STAMP_NS + 10**9)
    assert conversions.stamp_to_ns(bench.field.wait(bench.timeout_s).header.stamp) == STAMP_NS + 10**9


def test_a_scan_whose_last_bscans_never_come_is_given_up(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**OF_SCANNER, longest_bscan_wait_s=0.2)
    for bscan in bscans(volume)[:4]:
        bench.send(bscan)
    bench.until("C-scan dropped after 0.2 s: expected B-scan 4 of 6, none came; missing: 4 to 5")
    bench.send(bscans(volume)[4])
    bench.until("B-scan 0, which begins a C-scan, got B-scan 4")


@pytest.mark.parametrize("order", [[0, 1, 2, 2, 3, 4, 5], [0, 1, 3, 2, 4, 5], [0, 1, 2, 1, 3, 4, 5]])
def test_repeated_and_late_bscans_are_reported(
    trainer_bench: Callable[..., Any], volume: Volume, order: list[int]
) -> None:
    bench = trainer_bench(**OF_SCANNER)
    played = bscans(volume)
    for number, index in enumerate(order):
        bench.send(dataclasses.replace(played[index], stamp_ns=STAMP_NS + number * 1_000_000))
    bench.until("C-scan dropped: expected B-scan", f"got B-scan {order[3] if order[2] == 2 else order[2]}")
    bench.scan(volume, STAMP_NS + 10**9)
    assert conversions.stamp_to_ns(bench.field.wait(bench.timeout_s).header.stamp) == STAMP_NS + 10**9


def alien_image(bscan: BScan, **changes: Any) -> Image:
    image = conversions.to_image(bscan.image, bscan.stamp_ns, "oct_bscan_frame")
    for name, value in changes.items():
        setattr(image, name, value)
    return image


def play(bench: Any, played: list[BScan], index: int, image: Image, number: int, ahead_ns: int = 0) -> None:
    """Send B-scans of a scan of that number, as many seconds later, one of them with another image."""
    for bscan in played:
        stamp_ns = bscan.stamp_ns + number * 10**9
        own = conversions.to_image(bscan.image, stamp_ns, "oct_bscan_frame")
        if bscan.index == index:
            image.header.stamp = conversions.header(stamp_ns + ahead_ns, "").stamp
            own = image
        bench.bscan.publish(own)
        bench.bscan_pose.publish(conversions.matrix_to_pose_stamped(bscan.image2oct, stamp_ns, "oct_optical_frame"))


def test_alien_bscans_are_reported_with_their_index(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    played = bscans(volume)
    third = played[3]
    padded = np.zeros((24, 20), np.uint8)
    padded[:, :16] = third.image
    camera = alien_image(third)
    camera.header.frame_id = "camera_link"
    wide = conversions.to_image(third.image.astype(np.uint16), third.stamp_ns, "oct_bscan_frame")
    small = conversions.to_image(third.image[:-1], third.stamp_ns, "oct_bscan_frame")
    stepped = alien_image(third, step=20, data=conversions.to_bytes_field(padded.tobytes()))
    bench = trainer_bench(**OF_SCANNER)
    aliens = (
        (camera, "B-scan 3: expected an image sent as B-scan 0"),
        (wide, "B-scan 3: expected (24, 16) of uint8 as in B-scan 0, got (24, 16) of uint16"),
        (small, "B-scan 3: expected (24, 16) of uint8 as in B-scan 0, got (23, 16)"),
        (stepped, "rows of 20 bytes"),
        (alien_image(third, step=15), "step 15"),
        (alien_image(third, encoding="rgb8"), "'rgb8'"),
    )
    for number, (image, reason) in enumerate(aliens):
        play(bench, played, 3, image, number)
        bench.until("C-scan dropped", reason)
    play(bench, played, 3, alien_image(third), len(aliens), ahead_ns=1)  # no pose of it
    bench.until("C-scan dropped", "missing: 3")
    assert not bench.field.messages
    play(bench, played, -1, camera, len(aliens) + 1)
    field_of(bench)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("big", [False, True])
def test_endianness_and_row_padding_leave_the_voxels_alone(
    trainer_bench: Callable[..., Any], volume: Volume, dtype: Any, big: bool
) -> None:
    array = (volume.array.astype(dtype) * (200 if dtype == np.uint16 else 1)).astype(dtype)
    whole = Volume(array, volume.geometry, (0.0, 255.0 if dtype != np.uint16 else 65535.0))
    bench = trainer_bench(**OF_SCANNER)
    for bscan in bscans(whole):
        sent = bscan.image.astype(bscan.image.dtype.newbyteorder(">" if big else "<"))
        rows = np.full((24, sent.itemsize * 16 + 12), 0xAA, np.uint8)
        rows[:, : sent.itemsize * 16] = sent.view(np.uint8).reshape(24, -1)
        image = conversions.to_image(bscan.image, bscan.stamp_ns, "oct_bscan_frame")
        image.is_bigendian, image.step = int(big), rows.shape[1]
        image.data = conversions.to_bytes_field(rows.tobytes())
        bench.bscan.publish(image)
        bench.bscan_pose.publish(
            conversions.matrix_to_pose_stamped(bscan.image2oct, bscan.stamp_ns, "oct_optical_frame")
        )
    field = field_of(bench)
    np.testing.assert_array_equal(field.volume.array, array)
    assert field.volume.array.dtype == dtype


def test_a_scan_of_too_many_voxels_is_refused_at_its_first_bscan(
    trainer_bench: Callable[..., Any], volume: Volume
) -> None:
    bench = trainer_bench(**OF_SCANNER, largest_scan_voxels=volume.array.size - 1)
    bench.send(bscans(volume)[0])
    bench.until("C-scan dropped: B-scan 0: expected C-scans of at most 2,303 voxels")


def test_images_that_never_get_a_pose_do_not_pile_up(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**OF_SCANNER, largest_scan_voxels=volume.array.size)
    image = volume.array[0]
    for number in range(4 * volume.array.size // image.size + 1):
        bench.bscan.publish(conversions.to_image(image, STAMP_NS + number, "oct_bscan_frame"))
    bench.until("expected a bscan_pose of equal stamp", "got none for 25 images")
    bench.scan(volume, STAMP_NS + 10**9)
    field_of(bench)


def test_parameters_that_change_during_a_scan_end_it_and_say_so(
    trainer_bench: Callable[..., Any], volume: Volume
) -> None:
    bench = trainer_bench(**OF_SCANNER)
    for bscan in bscans(volume)[:3]:
        bench.send(bscan)
    bench.client.wait_for(lambda: bench.node._stream.received == 3, bench.timeout_s, "three B-scans")
    assert bench.set("intensity_scale", "log").successful
    bench.send(bscans(volume)[3])
    bench.until("parameters that describe it have changed; expected B-scan 3 of 6")


# --- what the arm did meanwhile


@pytest.mark.parametrize(
    ("moved", "reason"),
    [({"x_m": 3e-4}, "ee_pose moved by 300.0 um"), ({"angle_rad": 4e-3}, "ee_pose turned by 4.00 mrad")],
)
def test_a_scan_during_which_the_arm_moved_is_not_fitted(
    trainer_bench: Callable[..., Any], volume: Volume, moved: dict[str, float], reason: str
) -> None:
    bench = trainer_bench(**OF_SCANNER)
    publish_pose(bench, STAMP_NS)
    publish_pose(bench, STAMP_NS + 2_000_000, **moved)
    publish_pose(bench, LAST_NS)
    bench.client.wait_for(lambda: bench.node._poses.heard_until(LAST_NS), bench.timeout_s, "the poses")
    bench.scan(volume, STAMP_NS)
    bench.until("C-scan dropped: expected an arm that holds still", reason)
    assert not bench.field.messages
    assert bench.set("largest_scan_motion_m", 1e-3).successful
    assert bench.set("largest_scan_rotation_rad", 1e-2).successful
    bench.scan(volume, STAMP_NS)
    field_of(bench)


def test_an_arm_that_trembles_within_the_limit_holds_still(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**OF_SCANNER)
    for number in range(6):
        publish_pose(bench, STAMP_NS + number * 1_000_000, x_m=1e-4 * (number % 2), angle_rad=1e-3 * (number % 2))
    # Where it was before and where it goes afterwards is its own affair.
    publish_pose(bench, STAMP_NS - 20_000_000, x_m=0.1)
    publish_pose(bench, LAST_NS + 20_000_000, x_m=0.1)
    bench.client.wait_for(lambda: bench.node._poses.heard_until(LAST_NS + 1), bench.timeout_s, "the poses")
    bench.scan(volume, STAMP_NS)
    field_of(bench)


def test_a_complete_scan_waits_for_what_the_arm_has_yet_to_say(
    trainer_bench: Callable[..., Any], volume: Volume
) -> None:
    bench = trainer_bench(**OF_SCANNER, largest_pose_gap_s=20.0)
    publish_pose(bench, STAMP_NS)
    bench.client.wait_for(lambda: bench.node._poses.heard_until(STAMP_NS), bench.timeout_s, "the first pose")
    bench.scan(volume, STAMP_NS)
    bench.client.wait_for(lambda: bench.node._stream._unproven is not None, bench.timeout_s, "the whole C-scan")
    assert not bench.field.messages
    publish_pose(bench, LAST_NS + 1, x_m=0.01)
    bench.until("C-scan dropped: expected an arm that holds still", "moved by 10000.0 um")
    assert not bench.field.messages


def test_a_scan_takes_no_pose_of_after_a_clock_was_set_back(
    trainer_bench: Callable[..., Any], volume: Volume, capfd: pytest.CaptureFixture[str]
) -> None:
    bench = trainer_bench(**OF_SCANNER)
    publish_pose(bench, LAST_NS + 1, x_m=0.1)
    bench.client.wait_for(lambda: len(bench.node._poses) == 1, bench.timeout_s, "the pose")
    bench.scan(volume, STAMP_NS)
    bench.scan_ee_pose.wait(bench.timeout_s, after=1)  # with the field through the voxels, and with the fitted one
    for stamp_ns in (STAMP_NS - 2 * 10**9, STAMP_NS, STAMP_NS + 1):
        publish_pose(bench, stamp_ns, x_m=0.3)
    bench.client.wait_for(lambda: len(bench.node._poses) == 3, bench.timeout_s, "the poses of now, and no others")
    assert "ee_pose: its stamp lies 2.0 s before that of the last one" in capfd.readouterr().err
    assert bench.trigger("refit").success
    assert bench.scan_ee_pose.wait(bench.timeout_s, after=2).pose.position.x == 0.1


@pytest.mark.parametrize("simulated", [False, True], ids=["own time", "simulated time that stands still"])
def test_an_arm_that_falls_silent_holds_no_scan_up_for_long(
    trainer_bench: Callable[..., Any], volume: Volume, simulated: bool
) -> None:
    bench = trainer_bench(**OF_SCANNER, largest_pose_gap_s=0.3, use_sim_time=simulated)
    publish_pose(bench, STAMP_NS)
    bench.client.wait_for(lambda: bench.node._poses.heard_until(STAMP_NS), bench.timeout_s, "the first pose")
    bench.scan(volume, STAMP_NS)
    field_of(bench)


def test_a_scan_without_poses_of_an_arm_that_was_heard_is_taken_with_one_warning(
    trainer_bench: Callable[..., Any], volume: Volume
) -> None:
    bench = trainer_bench(**OF_SCANNER)
    bench.scan(volume, STAMP_NS)  # no arm at all: nothing to warn of
    field_of(bench)
    publish_pose(bench, STAMP_NS + 100 * 10**9)
    bench.client.wait_for(lambda: len(bench.node._poses) == 1, bench.timeout_s, "the pose")
    for number in (1, 2):
        stamp_ns = STAMP_NS + number * 10**9
        bench.scan(volume, stamp_ns)
        is_of = conversions.header(stamp_ns, "").stamp
        bench.field.wait(bench.timeout_s, lambda message, is_of=is_of: message.header.stamp == is_of)
    told = [status.read(message) for message in bench.progress.messages]
    doubts = [words for _, words, values in told if values.get("state") == "unplaced"]
    assert len(doubts) == 1
    assert f"nobody knows whether the arm moved during the C-scan at {STAMP_NS + 10**9} ns" in doubts[0]


# --- parameters, figures and health


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("bscan_count", 1, "at least 2 B-scans"),
        ("spacing_um", [28.0, 0.01459, 0.014], "spacing_um: expected micrometres, 0.1 or more, got 0.01459"),
        ("bscan_count", -1, "range"),
        ("spacing_um", [28.0, 0.0, 0.0], "axial and the lateral spacing both"),
        ("spacing_um", [28.0, 14.0, 0.0], "axial and the lateral spacing both"),
        ("spacing_um", [-1.0, 14.0, 14.0], "at least 0"),
        ("new_scan", "later", "restart, finish"),
        ("longest_bscan_wait_s", 0.0, "range"),
        ("bscan_reliability", "best_effort", "read-only"),
    ],
)
def test_bad_parameters_are_refused_with_the_reason(
    trainer_bench: Callable[..., Any], name: str, value: Any, reason: str
) -> None:
    bench = trainer_bench(**OF_SCANNER)
    result = bench.set(name, value)
    assert not result.successful
    assert reason in result.reason


def test_a_best_effort_scanner_is_heard(trainer_bench: Callable[..., Any], volume: Volume, client: Any) -> None:
    profile = qos.scan_profile(COUNT, "best_effort")
    bench = trainer_bench(**OF_SCANNER, bscan_reliability="best_effort")
    bench.bscan = client.node.create_publisher(Image, "bscan", profile)
    bench.bscan_pose = client.node.create_publisher(PoseStamped, "bscan_pose", profile)
    for publisher in (bench.bscan, bench.bscan_pose):
        client.wait_for(lambda publisher=publisher: publisher.get_subscription_count() > 0, bench.timeout_s, "trainer")
    bench.scan(volume, STAMP_NS)
    assert field_of(bench).geometry == volume.geometry


def test_what_float16_costs_is_stated_with_the_field(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(**OF_SCANNER)
    bench.scan(volume, STAMP_NS)
    received, done = bench.values("received"), bench.values("done")
    assert (received["field_kind"], done["field_kind"]) == ("interpolated", "neural")
    assert received["field_hash"] != done["field_hash"]
    assert 0.0 < float(done["float16_rms"]) <= float(done["float16_largest"]) < 0.01
    message = bench.field.wait(bench.timeout_s, lambda m: loads_field(conversions.field_data(m)).kind == "neural")
    training = loads_field(conversions.field_data(message)).description.training
    assert training["float16_rms"] == pytest.approx(float(done["float16_rms"]))
    assert training["float16_largest"] == pytest.approx(float(done["float16_largest"]))


def test_the_state_is_on_diagnostics(trainer_bench: Callable[..., Any], volume: Volume, client: Any) -> None:
    health = client.watch(DiagnosticArray, "/diagnostics", qos.STREAM)
    bench = trainer_bench(**OF_SCANNER)

    def told(accept: Callable[[dict[str, str]], bool]) -> dict[str, str]:
        def is_it(message: DiagnosticArray) -> bool:
            return message.status[0].name == "/octn/trainer: state" and accept(status.read(message)[2])

        return status.read(health.wait(bench.timeout_s, is_it))[2]

    assert told(lambda values: True)["state"] == "idle"
    stamp_ns = bench.node.get_clock().now().nanoseconds
    bench.scan(volume, stamp_ns)
    values = told(lambda values: values.get("field_kind") == "neural")
    assert 0.0 <= float(values["scan_age_s"]) < bench.timeout_s
    assert values["scan_stamp_ns"] == str(stamp_ns)
    assert values["fit.steps"] == "5"
    assert values["field_hash"] == bench.values("done")["field_hash"]
    bench.load("none.nii")
    values = told(lambda values: values.get("load_cscan.refused") == "1")
    assert "no such file" in values["last_error"]
