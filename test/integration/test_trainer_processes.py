"""The trainer in a process of its own: an interrupt in every state it can be in ends it in order."""

from __future__ import annotations

import contextlib
import gzip
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import LoadMap
from sensor_msgs.msg import CompressedImage, Image

from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.field_store import FieldStore
from octn_ros.simulation import PhantomConfig, Scanner, make_phantom
from octn_ros.volume import Volume, save_volume

START_TIMEOUT_S = 180.0
FIT_TIMEOUT_S = 180.0
EXIT_TIMEOUT_S = 30.0  # 2 s are promised, of a machine that does nothing else
SHAPE = (24, 64, 64)
SMALL_FIT = ("fit.steps:=20", "fit.batch:=1024", "fit.field.grid.log2_table_size:=12")
ENDLESS_FIT = ("fit.steps:=10000000", "fit.batch:=1024", "fit.field.grid.log2_table_size:=12")
STAMP_NS = 5_000_000_000


@pytest.fixture(scope="module")
def volume() -> Volume:
    return make_phantom(PhantomConfig(shape=SHAPE)).volume


class Process:
    """A trainer's process and a client that plays the scanner and the arm."""

    def __init__(self, client: Any, folder: Path, *assignments: str) -> None:
        self.client = client
        self.progress = client.watch(DiagnosticArray, "fit_progress")
        self.field = client.watch(CompressedImage, "field")
        node = client.node
        profile = qos.scan_profile(SHAPE[0])
        self.bscan = node.create_publisher(Image, "bscan", profile)
        self.bscan_pose = node.create_publisher(PoseStamped, "bscan_pose", profile)
        self.ee_pose = node.create_publisher(PoseStamped, "ee_pose", qos.STREAM)
        known = (f"bscan_count:={SHAPE[0]}", "spacing_um:=[0.0, 14.59, 14.0]", "device:=cpu", f"data_root:={folder}",
                 "fit.time_budget_s:=0.0", f"field_path:={folder / 'kept.zip'}", "longest_bscan_wait_s:=1000.0",
                 "largest_pose_gap_s:=1000.0")  # fmt: skip
        given = [part for assignment in (*known, *assignments) for part in ("-p", assignment)]
        publishers = (self.bscan, self.bscan_pose, self.ee_pose)
        # DDS keeps a killed process's subscriptions until its lease ends; what is sent meanwhile reaches nobody.
        for publisher in publishers:
            client.wait_for(
                lambda publisher=publisher: publisher.get_subscription_count() == 0,
                START_TIMEOUT_S,
                "the last one gone",
            )
        self.popen = subprocess.Popen([sys.executable, "-m", "octn_ros.nodes.trainer", "--ros-args", *given])
        for publisher in publishers:
            client.wait_for(
                lambda publisher=publisher: publisher.get_subscription_count() > 0, START_TIMEOUT_S, "trainer"
            )
        self.progress.wait_matched(START_TIMEOUT_S)

    def send(self, volume: Volume, count: int) -> None:
        """Play the first B-scans of a C-scan."""
        for bscan in list(Scanner(volume).bscans(STAMP_NS, 1_000_000))[:count]:
            self.bscan.publish(conversions.to_image(bscan.image, bscan.stamp_ns, "oct_bscan_frame"))
            self.bscan_pose.publish(
                conversions.matrix_to_pose_stamped(bscan.image2oct, bscan.stamp_ns, "oct_optical_frame")
            )

    def until(self, state: str) -> dict[str, str]:
        """Return the values of the first report in a state."""
        return status.read(
            self.progress.wait(FIT_TIMEOUT_S, lambda message: status.read(message)[2].get("state") == state)
        )[2]

    def healthy(self, accept: Callable[[dict[str, str]], bool]) -> None:
        """Wait for a report on the trainer's health."""
        health = self.client.watch(DiagnosticArray, "/diagnostics", qos.STREAM)
        health.wait(START_TIMEOUT_S, lambda message: accept(status.read(message)[2]))

    def interrupt(self) -> None:
        """Interrupt the process and see it end in order."""
        self.popen.send_signal(signal.SIGINT)
        began = time.monotonic()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.popen.wait(EXIT_TIMEOUT_S)
        took_s = time.monotonic() - began
        assert self.popen.returncode == 0, f"exit code {self.popen.returncode} after {took_s:.1f} s"


@pytest.fixture
def start(client: Any, tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Start a trainer's process; none outlives the test."""
    started: list[Process] = []

    def run(*assignments: str) -> Process:
        started.append(Process(client, tmp_path, *assignments))
        return started[-1]

    yield run
    for process in started:
        if process.popen.poll() is None:
            process.popen.kill()
            process.popen.wait()


def test_an_interrupt_in_the_middle_of_a_cscan(start: Callable[..., Process], volume: Volume) -> None:
    trainer = start()
    trainer.send(volume, 10)
    trainer.healthy(lambda values: values.get("bscans_received") == "10")
    trainer.interrupt()


def test_an_interrupt_while_a_cscan_waits_for_the_arm(start: Callable[..., Process], volume: Volume) -> None:
    trainer = start()
    trainer.ee_pose.publish(conversions.matrix_to_pose_stamped(np.eye(4), STAMP_NS, "base_link"))
    trainer.healthy(lambda values: values.get("ee_poses_kept") == "1")
    trainer.send(volume, SHAPE[0])
    trainer.healthy(lambda values: values.get("state") == "waiting for the arm")
    trainer.interrupt()


def test_an_interrupt_while_a_cscan_waits_for_a_fit(
    start: Callable[..., Process], volume: Volume, tmp_path: Path
) -> None:
    save_volume(tmp_path / "scan.nii", volume)
    trainer = start(*ENDLESS_FIT, "new_scan:=finish")
    for state in ("fitting", "waiting"):
        request = LoadMap.Request(map_url="scan.nii")
        answer = trainer.client.call(LoadMap, "load_cscan", request, START_TIMEOUT_S)
        assert answer.result == LoadMap.Response.RESULT_SUCCESS
        trainer.until(state)
    trainer.interrupt()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="only Linux tells which files a process has open")
def test_an_interrupt_while_a_file_is_read(start: Callable[..., Process], tmp_path: Path) -> None:
    # 32 MB that do not shrink: long enough to unpack for the interrupt to come meanwhile.
    large = np.random.default_rng(0).integers(0, 255, (256, 256, 512), dtype=np.uint8)
    save_volume(tmp_path / "plain.nii", Volume.from_array(large, (28e-6, 14e-6, 14e-6)))
    packed = tmp_path / "scan.nii.gz"
    packed.write_bytes(gzip.compress((tmp_path / "plain.nii").read_bytes(), compresslevel=1))
    trainer = start(*ENDLESS_FIT)
    client = trainer.client.node.create_client(LoadMap, "load_cscan")
    assert client.wait_for_service(START_TIMEOUT_S)
    client.call_async(LoadMap.Request(map_url="scan.nii.gz"))
    opened = Path("/proc", str(trainer.popen.pid), "fd")
    deadline = time.monotonic() + START_TIMEOUT_S
    while not _is_open(packed, opened):
        assert time.monotonic() < deadline
        time.sleep(0.001)
    trainer.interrupt()


def _is_open(file: Path, descriptors: Path) -> bool:
    for link in descriptors.iterdir():
        # Closed between listing and looking.
        with contextlib.suppress(FileNotFoundError):
            if link.readlink() == file:
                return True
    return False


def test_a_trainer_killed_in_a_fit_comes_back_with_the_field_before_it(
    start: Callable[..., Process], volume: Volume, tmp_path: Path
) -> None:
    first = start(*SMALL_FIT)
    first.send(volume, SHAPE[0])
    fitted = first.until("done")
    first.interrupt()
    kept = FieldStore(tmp_path / "kept.zip").load()
    assert kept is not None
    assert kept.hash == fitted["field_hash"]

    second = start(*ENDLESS_FIT)
    assert second.until("restored")["field_hash"] == kept.hash
    second.send(volume, SHAPE[0])
    second.progress.wait(FIT_TIMEOUT_S, lambda message: "loss" in status.read(message)[2])
    os.kill(second.popen.pid, signal.SIGKILL)
    second.popen.wait()

    third = start(*SMALL_FIT)
    assert third.until("restored")["field_hash"] == kept.hash
    field = third.field.wait(FIT_TIMEOUT_S)
    assert conversions.field_data(field) == kept.data
    third.send(volume, SHAPE[0])
    assert third.until("done")["state"] == "done", "a new scan works"
    third.interrupt()
