"""The simulator's scanner and arm: the client plays the trainer, and asks for what cannot be."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from octn_ros.errors import ConfigurationError
from octn_ros.nodes import conversions, qos
from octn_ros.nodes.simulator import Simulator
from octn_ros.simulation import PhantomConfig, Station, make_phantom
from octn_ros.volume import save_volume

TIMEOUT_S = 120.0
SHAPE = (5, 24, 16)


def test_a_scan_is_played_as_stamped_images_with_their_poses(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench()
    bench.scan()
    bench.bscan_pose.wait(TIMEOUT_S, lambda message: len(bench.bscan_pose.messages) >= SHAPE[0])
    volume = make_phantom(PhantomConfig(shape=SHAPE, surface="flat")).volume
    for index, (image, pose) in enumerate(zip(bench.bscan.messages, bench.bscan_pose.messages, strict=True)):
        assert image.header.stamp == pose.header.stamp
        assert (image.header.frame_id, pose.header.frame_id) == ("oct_bscan_frame", "oct_optical_frame")
        np.testing.assert_array_equal(conversions.image_to_array(image), volume.array[index])
        assert pose.pose.position.y == pytest.approx(index * 28e-6)
    assert bench.ee_pose.wait(TIMEOUT_S).header.frame_id == "base_link"


def test_a_scan_that_nobody_would_hear_is_refused(spin: Callable[..., Any], client: Any) -> None:
    spin(Simulator, phantom__shape=list(SHAPE))
    answer = client.call(Trigger, "scan", Trigger.Request(), TIMEOUT_S)
    assert not answer.success
    assert "nobody listens" in answer.message


def test_a_scan_at_no_time_is_refused(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(use_sim_time=True)
    assert "the clock stands at 0" in bench.call("scan").message


def test_a_recorded_volume_is_played_with_the_spacing_given(simulator_bench: Callable[..., Any], tmp_path: Any) -> None:
    volume = make_phantom(PhantomConfig(shape=SHAPE, surface="flat", seed=5)).volume
    save_volume(tmp_path / "scan.nii", volume)
    bench = simulator_bench(volume_file=str(tmp_path / "scan.nii"), spacing_um=[40.0, 5.0, 20.0])
    bench.scan()
    np.testing.assert_array_equal(conversions.image_to_array(bench.bscan.messages[-1]), volume.array[-1])
    last = bench.bscan_pose.wait(TIMEOUT_S, lambda message: message.pose.position.y > 3.5 * 40e-6)
    assert last.pose.position.y == pytest.approx(4 * 40e-6)


def test_a_phantom_that_cannot_be_is_refused_at_the_start(spin: Callable[..., Any]) -> None:
    with pytest.raises(ConfigurationError, match="surface"):
        spin(Simulator, phantom__shape=list(SHAPE), phantom__surface_depth_m=0.5)


def test_a_second_scan_shows_the_crater(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(phantom__shape=[40, 64, 80], laser__dwell_s=0.0015)
    bench.begin()
    bench.until("done")
    removed = conversions.image_to_array(
        bench.removed.wait(TIMEOUT_S, lambda message: max(conversions.image_to_array(message).ravel()) > 0)
    )
    assert removed.shape == (40, 80)
    before = len(bench.bscan.messages)
    bench.scan()
    scans = [
        np.stack([conversions.image_to_array(image) for image in images])
        for images in (bench.bscan.messages[:40], bench.bscan.messages[before : before + 40])
    ]
    row, column = np.unravel_index(np.argmax(removed), removed.shape)
    depths = [np.argmax(np.diff(scan[row, :, column - 1 : column + 2].mean(axis=1))) for scan in scans]
    assert (depths[1] - depths[0]) * 14.59e-6 == pytest.approx(removed[row, column], abs=2 * 14.59e-6)
    assert removed[row, column] > 50e-6
    far = scans[1][0].mean(axis=1) - scans[0][0].mean(axis=1)
    assert np.abs(far).max() < 20, "elsewhere it is the same tissue in other speckle"


def test_after_an_abort_the_arm_goes_back_before_it_scans(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(on_time=True)
    bench.executing()
    home = bench.ee_pose.messages[0].pose.position
    bench.call("abort")
    bench.until("aborted")
    away = len(bench.ee_pose.messages)
    stopped = bench.ee_pose.wait(TIMEOUT_S, after=away).pose.position
    assert abs(stopped.x - home.x) + abs(stopped.y - home.y) > 1e-4
    before = len(bench.bscan.messages)
    answer = bench.call("scan")
    assert answer.success, answer.message
    assert "once the arm is back" in answer.message
    first = bench.bscan.wait(TIMEOUT_S, after=before)
    pose = bench.ee_pose.wait(
        TIMEOUT_S,
        lambda message: conversions.stamp_to_ns(message.header.stamp) >= conversions.stamp_to_ns(first.header.stamp),
    )
    place = pose.pose.position
    assert (place.x, place.y, place.z) == pytest.approx((home.x, home.y, home.z), abs=1e-9)


def test_an_arm_that_does_not_get_home_in_time_is_not_scanned_from(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(on_time=True)
    bench.executing()
    bench.client.wait_for(lambda: bench.node._station.arm.progress[0] > 20, TIMEOUT_S, "arm away from home")
    bench.call("abort")
    before = len(bench.bscan.messages)
    bench.set("time_factor", 0.05)
    assert "once the arm is back" in bench.call("scan").message
    bench.set("time_factor", 0.01)
    bench.until("not where scans are taken in time", "the scan is cancelled")
    bench.set("time_factor", 100.0)
    bench.scan()
    bench.bscan.wait(TIMEOUT_S, lambda message: message.header.stamp != bench.bscan.messages[before].header.stamp)
    assert bench.node._station.at_home()


def test_an_abort_while_a_scan_is_made_ready_calls_it_off(
    simulator_bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = simulator_bench(on_time=True)
    bench.executing()
    bench.call("abort")
    look, looking, go_on = Station.look, threading.Event(), threading.Event()

    def slow(*arguments: Any) -> Any:
        looking.set()
        assert go_on.wait(TIMEOUT_S)
        return look(*arguments)

    monkeypatch.setattr(Station, "look", slow)
    before, asked = len(bench.bscan.messages), bench.client.node.create_client(Trigger, "scan")
    future = asked.call_async(Trigger.Request())
    assert looking.wait(TIMEOUT_S)
    assert bench.call("abort").message.startswith("the scan is cancelled")
    go_on.set()
    bench.client.wait_for(future.done, TIMEOUT_S, "answer")
    assert (future.result().success, "an abort was asked for" in future.result().message) == (False, True)
    assert bench.node._station.arm.state == "aborted", "the arm stays where it is"
    monkeypatch.undo()
    bench.scan()
    assert len(bench.bscan.messages) == before + bench.bscans


def test_a_sparse_scan_takes_as_much_less_time(simulator_bench: Callable[..., Any]) -> None:
    bench = simulator_bench(phantom__shape=[40, 64, 80], bscan_factor=4, bscan_period_s=0.01)
    bench.scan(bscans=10)
    stamps = [conversions.stamp_to_ns(image.header.stamp) for image in bench.bscan.messages]
    np.testing.assert_array_equal(np.diff(stamps), 10_000_000)
    bench.bscan_pose.wait(TIMEOUT_S, lambda message: len(bench.bscan_pose.messages) >= 10)
    places = [pose.pose.position.y for pose in bench.bscan_pose.messages]
    np.testing.assert_allclose(places, 4 * 28e-6 * np.arange(10), atol=1e-12)
    assert len(bench.bscan.messages) == 10


def test_a_best_effort_scanner_says_so(spin: Callable[..., Any], client: Any) -> None:
    spin(Simulator, phantom__shape=list(SHAPE), bscan_reliability="best_effort")
    heard = client.watch(Image, "bscan", qos.scan_profile(SHAPE[0], "best_effort"))
    client.watch(PoseStamped, "bscan_pose", qos.scan_profile(SHAPE[0], "best_effort"))
    client.wait_for(lambda: client.call(Trigger, "scan", Trigger.Request(), TIMEOUT_S).success, TIMEOUT_S, "scan")
    assert heard.wait(TIMEOUT_S).height == SHAPE[1]
