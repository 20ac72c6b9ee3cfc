"""The small parts of the nodes that need no graph."""

import threading

import numpy as np
import pytest
import torch
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, HistoryPolicy, ReliabilityPolicy
from sensor_msgs.msg import Image

from octn_ros.errors import ConfigurationError, PlanError, VolumeError
from octn_ros.field.device import torch_device
from octn_ros.nodes import bscan_pairs, conversions, pose_history, qos
from octn_ros.nodes.bscan_pairs import BScanPairs
from octn_ros.nodes.frames import ScanFrames
from octn_ros.nodes.pose_history import PoseHistory, StampedPose
from octn_ros.nodes.worker import Worker
from octn_ros.planning import from_translation_quaternion, invert, load_calibration
from octn_ros.resources import config_path

WAIT_S = 120.0


def test_the_worker_keeps_only_the_newest_waiting_job() -> None:
    worker, go, done, order = Worker("test"), threading.Event(), threading.Event(), []
    started = threading.Event()

    def first(cancelled) -> None:
        started.set()
        go.wait(WAIT_S)
        order.append("first")

    assert not worker.submit(first)
    assert started.wait(WAIT_S)
    assert worker.submit(lambda cancelled: order.append("second"))
    assert worker.submit(lambda cancelled: (order.append("third"), done.set()))
    go.set()
    assert done.wait(WAIT_S)
    assert order == ["first", "third"]
    worker.close(WAIT_S)


def test_cancel_reaches_the_running_job_and_forgets_the_waiting_one() -> None:
    worker, started, ended, ran = Worker("test"), threading.Event(), threading.Event(), []

    def job(cancelled) -> None:
        started.set()
        while not cancelled():
            pass
        ended.set()

    assert not worker.cancel()
    worker.submit(job)
    assert started.wait(WAIT_S)
    worker.submit(lambda cancelled: ran.append(1))
    assert worker.cancel()
    assert ended.wait(WAIT_S)
    worker.close(WAIT_S)
    assert not ran


def test_a_job_that_raises_is_shown_and_the_next_one_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, done = [], threading.Event()
    monkeypatch.setattr(threading, "excepthook", lambda arguments: shown.append(arguments.exc_value))

    def wrong(cancelled) -> None:
        raise RuntimeError("a fault")

    worker = Worker("test")
    worker.submit(wrong)
    while worker.busy:
        pass
    assert [str(error) for error in shown] == ["a fault"]
    worker.submit(lambda cancelled: done.set())
    assert done.wait(WAIT_S)
    worker.close(WAIT_S)


def stamped(kind: type, stamp_ns: int) -> Image | PoseStamped:
    return kind(header=conversions.header(stamp_ns, ""))


def test_images_and_poses_meet_whichever_comes_first() -> None:
    pairs = BScanPairs(1)
    assert pairs.add_image(stamped(Image, 1)) is None
    assert pairs.add_image(stamped(Image, 2)) is None
    image, pose = pairs.add_pose(stamped(PoseStamped, 1))
    assert image.header.stamp == pose.header.stamp
    assert pairs.add_pose(stamped(PoseStamped, 3)) is None
    image, _ = pairs.add_image(stamped(Image, 3))
    assert conversions.stamp_to_ns(image.header.stamp) == 3
    assert pairs.add_pose(stamped(PoseStamped, 2)) is None, "older than a complete pair: its image is forgotten"


def test_the_pose_nearest_in_time_is_found_within_the_gap() -> None:
    history = PoseHistory()
    assert history.nearest(0, 1.0) is None
    for second in range(5):
        history.add(StampedPose(second * 10**9, np.full((4, 4), second), "base_link"))
    assert history.nearest(2_400_000_000, 0.5).stamp_ns == 2 * 10**9
    assert history.nearest(9 * 10**9, 0.5) is None


def test_two_minutes_of_poses_are_remembered_a_thousand_a_second() -> None:
    history, still = PoseHistory(), np.eye(4)
    for number in range(12_100):  # of an arm that tells a hundred a second
        history.add(StampedPose(number * 10**7, still, "base_link"))
    assert history.nearest(1_400_000_000, 0.5).stamp_ns == 1_400_000_000
    assert history.nearest(0, 0.5) is None, "older than two minutes"
    assert len(history) == 12_001
    assert pose_history.MOST * 10**6 >= pose_history.KEPT_NS


def test_poses_of_before_a_clock_was_set_back_are_forgotten() -> None:
    history = history_of((4.0, 0.1, 0.0), (5.0, 0.1, 0.0), (4.5, 0.2, 0.0))
    assert len(history) == 3, "no clock is set back by half a second: it came late"
    assert not history.heard_until(5_000_000_001)
    assert history.add(StampedPose(3_999_999_999, np.eye(4), "base_link")) == pytest.approx(1.0)
    assert len(history) == 1
    assert not history.heard_until(4 * 10**9)


def test_images_without_poses_are_forgotten_before_they_fill_the_memory() -> None:
    pairs = BScanPairs(100)
    for stamp_ns in range(1, 5):
        image = stamped(Image, stamp_ns)
        image.data = conversions.to_bytes_field(bytes(25))
        assert pairs.add_image(image) is None
    with pytest.raises(VolumeError, match="got none for 5 images of 126 bytes"):
        pairs.add_image(Image(header=conversions.header(5, ""), data=conversions.to_bytes_field(bytes(26))))
    assert pairs.add_pose(stamped(PoseStamped, 5)) is None
    assert pairs.add_image(stamped(Image, 6)) is None
    assert pairs.add_pose(stamped(PoseStamped, 6)) is not None


def test_images_without_data_are_forgotten_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bscan_pairs, "_MOST", 4)
    pairs = BScanPairs(100)
    for stamp_ns in (1, 1, 2, 3, 4):
        assert pairs.add_image(stamped(Image, stamp_ns)) is None
    with pytest.raises(VolumeError, match="got none for 5 images of 0 bytes"):
        pairs.add_image(stamped(Image, 5))
    assert pairs.add_pose(stamped(PoseStamped, 5)) is None


def test_a_job_that_restarts_ends_the_running_one_and_is_next() -> None:
    worker, started, ended, done = Worker("test"), threading.Event(), threading.Event(), threading.Event()

    def endless(cancelled) -> None:
        started.set()
        while not cancelled():
            pass
        ended.set()

    worker.submit(endless)
    assert started.wait(WAIT_S)
    assert worker.submit(lambda cancelled: done.set(), restart=True)
    assert ended.wait(WAIT_S)
    assert done.wait(WAIT_S)
    worker.close(WAIT_S)
    assert worker.cancel() == 0


def history_of(*poses: tuple[float, float, float]) -> PoseHistory:
    """Return a history of (second, x in m, angle about z in rad)."""
    history = PoseHistory()
    for second, x, angle in poses:
        ee2base = from_translation_quaternion((x, 0.0, 0.0), (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))
        history.add(StampedPose(round(second * 1e9), ee2base, "base_link"))
    return history


def test_motion_is_the_largest_way_from_the_pose_at_the_start() -> None:
    history = history_of((0.0, 5.0, 0.0), (1.0, 0.1, 0.0), (1.5, 0.4, 0.2), (2.0, -0.1, -1e-6), (3.0, 9.0, 0.0))
    motion = history.motion(10**9, 2 * 10**9, 0.5)
    assert motion is not None
    assert motion.translation_m == pytest.approx(0.3)
    assert motion.rotation_rad == pytest.approx(0.2)
    small = history_of((1.0, 0.0, 0.0), (2.0, 0.0, 1e-6)).motion(10**9, 2 * 10**9, 0.5)
    assert small is not None
    assert small.rotation_rad == pytest.approx(1e-6, rel=1e-6)


def test_where_poses_are_rare_the_first_one_after_the_stretch_counts() -> None:
    history = history_of((0.9, 0.0, 0.0), (2.1, 0.5, 0.0), (2.2, 7.0, 0.0))
    motion = history.motion(10**9, 2 * 10**9, 0.5)
    assert motion is not None
    assert motion.translation_m == pytest.approx(0.5)
    assert history.motion(10**9, 2 * 10**9, 0.05) is None, "nobody knows where the arm was"
    assert not history.heard_until(2_200_000_001)
    assert history.heard_until(2_200_000_000)


def pose_in(frame: str, pose: np.ndarray) -> PoseStamped:
    return conversions.matrix_to_pose_stamped(pose, 0, frame)


def test_frames_lead_back_to_the_oct_frame() -> None:
    calibration = load_calibration(config_path("calibration.yaml"))
    ee2base = from_translation_quaternion((0.4, -0.1, 0.3), (0.0, 1.0, 0.0, 0.0))
    pose = from_translation_quaternion((1e-3, 2e-3, 5e-4), (0.0, 0.0, 0.6, 0.8))
    frames = ScanFrames(calibration, ee2base)
    for frame, oct2frame in (
        ("oct_optical_frame", np.eye(4)),
        ("tool0", calibration.oct2ee),
        ("base_link", ee2base @ calibration.oct2ee),
        ("laser_frame", invert(calibration.laser2ee) @ calibration.oct2ee),
    ):
        np.testing.assert_allclose(frames.to_oct(pose_in(frame, oct2frame @ pose)), pose, atol=1e-12)


def test_a_frame_nobody_knows_is_refused_with_those_that_are_known() -> None:
    frames = ScanFrames(load_calibration(config_path("calibration.yaml")))
    with pytest.raises(PlanError, match=r"oct_optical_frame, tool0, laser_frame, got frame_id 'map'$"):
        frames.to_oct(pose_in("map", np.eye(4)))
    with pytest.raises(PlanError, match="scan_ee_pose"):
        frames.to_oct(pose_in("base_link", np.eye(4)))


def test_devices_are_checked() -> None:
    assert torch_device("cpu") == torch.device("cpu")
    assert torch_device("auto").type in ("cpu", "cuda")
    with pytest.raises(ConfigurationError, match="abacus"):
        torch_device("abacus")


def test_profiles() -> None:
    assert qos.LATCHED.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert qos.LATCHED.depth == 1
    for profile in (qos.LATCHED, qos.STREAM, qos.scan_profile(4)):
        assert profile.reliability == ReliabilityPolicy.RELIABLE
        assert profile.history == HistoryPolicy.KEEP_LAST
    assert qos.scan_profile(5000).depth == 5000
    assert qos.scan_profile(0).depth >= 512
