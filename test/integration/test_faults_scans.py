"""B-scans and poses that get lost at random: no C-scan with a gap is ever fitted, and each gap is reported."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CompressedImage, Image

from octn_ros.field import loads_field
from octn_ros.nodes import conversions, qos, status
from octn_ros.simulation import BScan, PhantomConfig, Scanner, make_phantom
from octn_ros.volume import Volume

START_S, ANSWER_S = 180.0, 120.0
COUNT, SCANS = 6, 60
SHAPE = (COUNT, 24, 16)
SPACING_UM = (28.0, 14.59, 14.0)
PERIOD_NS = 1_000_000_000  # from C-scan to C-scan
GIVEN = (
    f"bscan_count:={COUNT}", f"spacing_um:={list(SPACING_UM)}", "device:=cpu", "field_path:=''",
    "longest_bscan_wait_s:=1000.0", "fit.steps:=1", "fit.batch:=256", "fit.time_budget_s:=0.0",
    "fit.field.grid.log2_table_size:=10",
)  # fmt: skip


@dataclasses.dataclass
class Loss:
    """Which messages of a C-scan get lost, by the number of their B-scan."""

    images: set[int]
    poses: set[int]

    @property
    def whole(self) -> bool:
        return not self.images | self.poses


def random_losses(seed: int) -> list[Loss]:
    """Of every three C-scans one loses images, one loses poses or both, one loses nothing; the last one is whole."""
    rng = np.random.default_rng(seed)
    losses = []
    for number in range(SCANS):
        lost = [set(rng.choice(COUNT, size=rng.integers(1, 4), replace=False).tolist()) for _ in range(2)]
        losses.append((Loss(lost[0], set()), Loss(lost[0], lost[1]), Loss(set(), set()))[number % 3])
    order = rng.permutation(SCANS - 1).tolist()
    # The end of one and the beginning of the next are lost: what is left looks like a C-scan.
    between = [Loss({4, 5}, set()), Loss({0, 1, 2, 3}, set())]
    return [*between, *(losses[number] for number in order[len(between) :]), losses[-1]]


def told_of(losses: list[Loss]) -> Iterator[str]:
    """Yield what has to be reported: the stamp of each whole C-scan, and the words that name each gap."""
    of_scans: list[int] = []  # of which C-scan each B-scan is that has been taken
    aside = False
    for number, loss in enumerate(losses):
        for index in (i for i in range(COUNT) if i not in loss.images | loss.poses):
            expected = len(of_scans)
            if aside and index:
                continue
            if index == 0:
                of_scans, aside = [number], False
                if expected:
                    yield f"expected B-scan {expected} of {COUNT}, got B-scan 0; the C-scan of {expected} B-scans is"
            elif index == expected:
                of_scans.append(number)
            else:
                of_scans, aside = [], True
                yield gap(expected, index)
        if len(of_scans) == COUNT:
            jumps = np.diff(of_scans)
            place = int(jumps.argmax())
            aside = bool(jumps.any())
            mixed = f"that of B-scan {place} than the 4 ms that all others take, got one {1000 * jumps[place] + 1} ms"
            yield mixed if aside else str((number + 1) * PERIOD_NS)
            of_scans = []


def gap(expected: int, index: int) -> str:
    if expected == 0:
        return f"expected B-scan 0, which begins a C-scan, got B-scan {index};"
    if index < expected:
        return f"expected B-scan {expected} of {COUNT}, got B-scan {index} again"
    missing = str(expected) if index == expected + 1 else f"{expected} to {index - 1}"
    return f"expected B-scan {expected} of {COUNT}, got B-scan {index}; missing: {missing}"


def without_repetitions(told: list[str]) -> list[str]:
    """Drop the reason that is the same as the last one, for the trainer says it once a second."""
    kept, last = [], ""
    for text in told:
        if text.isdigit() or text != last:
            kept.append(text)
        last = last if text.isdigit() else text
    return kept


@pytest.fixture(scope="module")
def volume() -> Volume:
    spacing_m = tuple(spacing * 1e-6 for spacing in SPACING_UM)
    return make_phantom(PhantomConfig(shape=SHAPE, spacing_m=spacing_m, surface="flat")).volume


@pytest.mark.parametrize("seed", range(3))
def test_of_scans_with_random_losses_only_whole_ones_are_shown_and_every_gap_is_told(
    launch: Callable[..., Any], client: Any, volume: Volume, seed: int
) -> None:
    progress = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
    fields = client.watch(CompressedImage, "field")
    profile = qos.scan_profile(COUNT)
    images = client.node.create_publisher(Image, "bscan", profile)
    poses = client.node.create_publisher(PoseStamped, "bscan_pose", profile)
    launch("trainer", *GIVEN)
    for publisher in (images, poses):
        client.wait_for(lambda publisher=publisher: publisher.get_subscription_count() > 0, START_S, "trainer")
    progress.wait_matched(START_S)

    losses = random_losses(seed)
    scans = [dataclasses.replace(volume, array=np.roll(volume.array, shift, axis=1)) for shift in range(SCANS)]
    for number, (loss, scan) in enumerate(zip(losses, scans, strict=True)):
        for bscan in Scanner(scan).bscans((number + 1) * PERIOD_NS, 1_000_000):
            kept = bscan.index not in loss.images, bscan.index not in loss.poses
            send(bscan, *(publisher if keep else None for publisher, keep in zip((images, poses), kept, strict=True)))

    last = str(SCANS * PERIOD_NS)
    progress.wait(ANSWER_S, lambda message: heard(message) == last)
    told = without_repetitions([text for text in map(heard, progress.messages) if text])
    wanted = without_repetitions(list(told_of(losses)))
    assert len(told) == len(wanted)
    for text, words in zip(told, wanted, strict=True):
        assert words in text

    fields.wait(ANSWER_S, lambda message: conversions.stamp_to_ns(message.header.stamp) == SCANS * PERIOD_NS)
    for message in fields.messages:
        number = conversions.stamp_to_ns(message.header.stamp) // PERIOD_NS - 1
        field = loads_field(conversions.field_data(message))
        assert losses[number].whole
        if field.kind == "interpolated":
            np.testing.assert_array_equal(field.volume.array, scans[number].array)


def send(bscan: BScan, images: Any, poses: Any) -> None:
    """Publish of a B-scan what does not get lost."""
    if images is not None:
        images.publish(conversions.to_image(bscan.image, bscan.stamp_ns, "oct_bscan_frame"))
    if poses is not None:
        poses.publish(conversions.matrix_to_pose_stamped(bscan.image2oct, bscan.stamp_ns, "oct_optical_frame"))


def heard(message: Any) -> str:
    """Return what a report says of a C-scan that came: its stamp, or why it was dropped; nothing of other matters."""
    _, text, values = status.read(message)
    return {"received": values.get("stamp_ns", ""), "refused": text}.get(values.get("state", ""), "")
