"""What a new C-scan does to a fit that runs, and what becomes of one that waits for it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CompressedImage

from octn_ros.field import loads_field
from octn_ros.nodes import conversions, field_fitter, status
from octn_ros.planning import from_translation_quaternion
from octn_ros.volume import Volume

OF_SCANNER = {"bscan_count": 6, "spacing_um": [28.0, 14.59, 14.0]}


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Fits wait for this event, or to be cancelled, before they begin."""
    event, fit = threading.Event(), field_fitter.fit

    def waiting(volume: Volume, config: Any, *, cancelled: Callable[[], bool], **options: Any) -> Any:
        while not event.is_set() and not cancelled():
            time.sleep(0.005)
        return fit(volume, config, cancelled=cancelled, **options)

    monkeypatch.setattr(field_fitter, "fit", waiting)
    yield event
    event.set()


@pytest.fixture
def fitting(trainer_bench: Callable[..., Any], volume: Volume, held: threading.Event) -> Callable[[str], Any]:
    """Make a trainer that does with a new scan as it is told and is held in the fit of the scan of second 1."""

    def make(new_scan: str) -> Any:
        bench = trainer_bench(**OF_SCANNER, new_scan=new_scan)
        bench.scan(volume, 1 * 10**9)
        until_report(bench, 1, "fitting")
        return bench

    return make


def heard(bench: Any) -> list[tuple[int, str]]:
    """Return stamp (in s) and kind of the fields so far."""
    return [
        (message.header.stamp.sec, loads_field(conversions.field_data(message)).kind)
        for message in bench.field.messages
    ]


def until_field(bench: Any, second: int, kind: str) -> None:
    def is_it(message: CompressedImage) -> bool:
        return message.header.stamp.sec == second and loads_field(conversions.field_data(message)).kind == kind

    bench.field.wait(bench.timeout_s, is_it)


def until_report(bench: Any, second: int, state: str) -> dict[str, str]:
    def is_it(message: DiagnosticArray) -> bool:
        values = status.read(message)[2]
        return values.get("state") == state and values.get("stamp_ns") == str(second * 10**9)

    return status.read(bench.progress.wait(bench.timeout_s, is_it))[2]


def test_restart_gives_the_running_fit_up_for_the_new_scan(
    fitting: Callable[[str], Any], volume: Volume, held: threading.Event
) -> None:
    bench = fitting("restart")
    bench.scan(volume, 2 * 10**9)
    until_report(bench, 1, "superseded")
    held.set()
    until_field(bench, 2, "neural")
    assert heard(bench) == [(1, "interpolated"), (2, "interpolated"), (2, "neural")]


def test_finish_ends_the_running_fit_and_then_takes_the_newest_scan(
    fitting: Callable[[str], Any], volume: Volume, held: threading.Event
) -> None:
    bench = fitting("finish")
    for second in (2, 3):
        bench.scan(volume, second * 10**9)
        until_report(bench, second, "waiting")
    assert heard(bench) == [(1, "interpolated")], "the present scan stays until its fit is done"
    held.set()
    until_field(bench, 3, "neural")
    assert heard(bench) == [(1, "interpolated"), (1, "neural"), (3, "interpolated"), (3, "neural")]


def test_a_scan_that_waits_keeps_its_pose_however_long_that_is(
    fitting: Callable[[str], Any], volume: Volume, held: threading.Event
) -> None:
    bench = fitting("finish")
    for number, stamp_ns in enumerate((2_010_000_000, 2_001_000_000), start=1):
        pose = from_translation_quaternion((0.1 * number, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        bench.ee_pose.publish(conversions.matrix_to_pose_stamped(pose, stamp_ns, "base_link"))
        bench.client.wait_for(lambda number=number: len(bench.node._poses) == number, bench.timeout_s, "the pose")
        if number == 1:
            bench.scan(volume, 2 * 10**9)
            until_report(bench, 2, "waiting")
    bench.node._poses._poses.clear()  # as two minutes do
    held.set()
    bench.scan_ee_pose.wait(bench.timeout_s, lambda message: message.pose.position.x == 0.2)
    assert bench.pose_told(2 * 10**9)[0, 3] == 0.2


def test_cancel_ends_both_fits_and_refit_takes_the_scan_that_waited(
    fitting: Callable[[str], Any], volume: Volume, held: threading.Event
) -> None:
    bench = fitting("finish")
    bench.scan(volume, 2 * 10**9)
    until_report(bench, 2, "waiting")
    answer = bench.trigger("cancel")
    assert answer.success
    assert answer.message == "both fits are cancelled; refit fits the C-scan that waited"
    until_report(bench, 1, "cancelled")
    held.set()
    assert bench.trigger("refit").success
    until_field(bench, 2, "neural")
    assert heard(bench) == [(1, "interpolated"), (2, "interpolated"), (2, "neural")]


def test_refit_follows_the_parameter_too(fitting: Callable[[str], Any], held: threading.Event) -> None:
    bench = fitting("finish")
    assert bench.trigger("refit").message == "the present fit ends first, then this one begins"
    assert bench.set("new_scan", "restart").successful
    assert bench.trigger("refit").message == "the present fit is given up, and this one begins"
    until_report(bench, 1, "cancelled")
    held.set()
    until_field(bench, 1, "neural")
