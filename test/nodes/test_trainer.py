"""The trainer alone: files, B-scans that do not fit, and what it says about them."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import LoadMap
from PIL import Image as PngImage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger

from octn_ros.field import InterpolatedField, field_hash, loads_field
from octn_ros.nodes import conversions, qos, status, trainer
from octn_ros.nodes.trainer import Trainer
from octn_ros.planning import from_translation_quaternion
from octn_ros.simulation import PhantomConfig, Scanner, make_phantom
from octn_ros.training.divergence import DivergenceGuard
from octn_ros.volume import Volume, save_volume

TIMEOUT_S = 30.0
SHAPE = (6, 24, 16)
SPACING_UM = [28.0, 14.59, 14.0]
SPACING_M = tuple(s * 1e-6 for s in SPACING_UM)
FIT = {
    "fit__steps": 5,
    "fit__batch": 256,
    "fit__time_budget_s": 0.0,
    "fit__field__grid__log2_table_size": 10,
    "device": "cpu",
}
BASE = "base_link"


@pytest.fixture(scope="module")
def volume() -> Volume:
    return make_phantom(PhantomConfig(shape=SHAPE, spacing_m=SPACING_M, surface="flat")).volume


class Bench:
    """The trainer and a client that plays the scanner."""

    def __init__(self, spin: Callable[..., Any], client: Any, **parameters: Any) -> None:
        self.client = client
        self.progress = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
        self.field = client.watch(CompressedImage, "field")
        self.enface = client.watch(OccupancyGrid, "enface")
        self.scan_ee_pose = client.watch(PoseStamped, "scan_ee_pose")
        profile = qos.scan_profile(SHAPE[0])
        self.bscan = client.node.create_publisher(Image, "bscan", profile)
        self.bscan_pose = client.node.create_publisher(PoseStamped, "bscan_pose", profile)
        self.ee_pose = client.node.create_publisher(PoseStamped, "ee_pose", qos.STREAM)
        spin(Trainer, **(FIT | parameters))
        self.progress.wait_matched(TIMEOUT_S)
        for publisher in (self.bscan, self.bscan_pose, self.ee_pose):
            client.wait_for(lambda publisher=publisher: publisher.get_subscription_count() > 0, TIMEOUT_S, "trainer")

    def load(self, url: str) -> Any:
        return self.client.call(LoadMap, "load_cscan", LoadMap.Request(map_url=url), TIMEOUT_S)

    def scan(self, volume: Volume, start_ns: int, *, skip: int = -1, frame: str = "oct_optical_frame") -> None:
        for bscan in Scanner(volume).bscans(start_ns, 1_000_000):
            if bscan.index != skip:
                self.bscan.publish(conversions.to_image(bscan.image, bscan.stamp_ns, "oct_bscan_frame"))
                self.bscan_pose.publish(conversions.matrix_to_pose_stamped(bscan.image2oct, bscan.stamp_ns, frame))

    def pose_told(self, stamp_ns: int) -> Any:
        """Return the latest pose of the scan as it is published."""
        self.scan_ee_pose.wait(TIMEOUT_S)
        message = self.scan_ee_pose.messages[-1]
        assert message.header == conversions.header(stamp_ns, BASE)
        return conversions.pose_to_matrix(message.pose)

    def until(self, *words: str) -> Any:
        return self.progress.wait(TIMEOUT_S, lambda message: all(word in status.read(message)[1] for word in words))


def kind_of(message: CompressedImage) -> str:
    return loads_field(conversions.field_data(message)).kind


def is_neural(message: CompressedImage) -> bool:
    return kind_of(message) == "neural"


def test_a_file_becomes_an_en_face_view_and_a_field_at_once_and_then_a_fitted_one(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    bench = Bench(spin, client)
    path = tmp_path / "a scan.nii.gz"
    save_volume(path, volume)
    answer = bench.load(path.as_uri())
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    assert answer.map.info.width == SHAPE[2]
    assert answer.map == bench.enface.wait(TIMEOUT_S)
    bench.field.wait(TIMEOUT_S, is_neural)
    assert [kind_of(message) for message in bench.field.messages] == ["interpolated", "neural"]
    for message in bench.field.messages:
        assert message.header.stamp == answer.map.header.stamp
        assert message.header.frame_id == "oct_optical_frame"
        field = loads_field(conversions.field_data(message))
        assert field.geometry.shape == SHAPE
        assert field.description.stamp_ns == conversions.stamp_to_ns(message.header.stamp)
    level, _, values = status.read(bench.until("field fitted"))
    assert level == status.OK
    assert (values["state"], values["ended"]) == ("done", "steps")
    assert values["field_hash"] == field_hash(conversions.field_data(bench.field.messages[-1]))
    assert float(values["psnr_db"]) > 0.0
    assert not bench.scan_ee_pose.messages, "nobody said where the arm was"
    assert bench.load(str(path)).result == LoadMap.Response.RESULT_SUCCESS, "a plain path does as well"


def test_a_file_without_spacing_takes_the_parameter_or_is_refused(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    path = tmp_path / "unstated.nii"
    nibabel.save(nibabel.Nifti1Image(volume.array, np.eye(4)), path)
    bench = Bench(spin, client)
    assert bench.load(str(path)).result == LoadMap.Response.RESULT_INVALID_MAP_DATA
    bench.until("load_cscan refused", "spacing")
    request = SetParameters.Request(parameters=[Parameter("spacing_um", value=SPACING_UM).to_parameter_msg()])
    assert client.call(SetParameters, "trainer/set_parameters", request, TIMEOUT_S).results[0].successful
    answer = bench.load(str(path))
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    assert answer.map.info.resolution == pytest.approx(14e-6)


def test_a_folder_of_images_is_a_scan_too(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    for number, bscan in enumerate(volume.array):
        PngImage.fromarray(bscan).save(tmp_path / f"bscan_{number}.png")
    bench = Bench(spin, client, spacing_um=SPACING_UM)
    assert bench.load(tmp_path.as_uri()).result == LoadMap.Response.RESULT_SUCCESS
    assert loads_field(conversions.field_data(bench.field.wait(TIMEOUT_S))).geometry.shape == SHAPE


def test_files_that_cannot_be_used_are_refused_in_words(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    bench = Bench(spin, client)
    missing, invalid = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST, LoadMap.Response.RESULT_INVALID_MAP_DATA
    good = tmp_path / "good.nii"
    save_volume(good, volume)
    (tmp_path / "empty.nii").touch()
    (tmp_path / "cut.nii").write_bytes(good.read_bytes()[:-100])
    cases = [
        (str(tmp_path / "none.nii"), missing, "no such file"),
        (str(tmp_path), invalid, "images"),
        ("", LoadMap.Response.RESULT_UNDEFINED_FAILURE, "map_url"),
        ("https://example.org/scan.nii", LoadMap.Response.RESULT_UNDEFINED_FAILURE, "of this machine"),
        (str(tmp_path / "empty.nii"), invalid, "empty"),
        (str(tmp_path / "cut.nii"), invalid, "cut.nii"),
    ]
    for url, result, reason in cases:
        answer = bench.load(url)
        assert answer.result == result, url
        assert not answer.map.data
        assert status.read(bench.until("load_cscan refused", reason))[0] == status.ERROR
    assert not bench.field.messages
    assert bench.load(str(good)).result == LoadMap.Response.RESULT_SUCCESS, "the node lives on"


def test_bscans_become_a_field_with_the_pose_of_the_arm(spin: Callable[..., Any], client: Any, volume: Volume) -> None:
    bench = Bench(spin, client, bscan_count=SHAPE[0], spacing_um=SPACING_UM)
    start_ns = 5_000_000_000
    ee2base = from_translation_quaternion((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
    for offset_ns, pose in ((-900_000_000, np.eye(4)), (20_000_000, ee2base), (900_000_000, np.eye(4))):
        bench.ee_pose.publish(conversions.matrix_to_pose_stamped(pose, start_ns + offset_ns, BASE))
    bench.scan(volume, start_ns)
    field = bench.field.wait(TIMEOUT_S, is_neural)
    assert conversions.stamp_to_ns(field.header.stamp) == start_ns
    # The pose may be heard before the scan is complete or after its fit.
    assert bench.pose_told(start_ns) == pytest.approx(ee2base)


def test_a_nearer_pose_is_published_when_it_comes_whether_or_not_a_fit_ends(
    spin: Callable[..., Any], client: Any, volume: Volume
) -> None:
    bench = Bench(spin, client, bscan_count=SHAPE[0], spacing_um=SPACING_UM)
    start_ns = 5_000_000_000
    far, near = (from_translation_quaternion((x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) for x in (0.3, 0.1))
    bench.scan(volume, start_ns)
    bench.until("field fitted")
    assert not bench.scan_ee_pose.messages
    bench.ee_pose.publish(conversions.matrix_to_pose_stamped(far, start_ns - 300_000_000, BASE))
    assert bench.pose_told(start_ns) == pytest.approx(far)
    # Further away than the last one, on either side: nothing new to say.
    for offset_ns in (-400_000_000, 300_000_000):
        bench.ee_pose.publish(conversions.matrix_to_pose_stamped(np.eye(4), start_ns + offset_ns, BASE))
    bench.ee_pose.publish(conversions.matrix_to_pose_stamped(near, start_ns + 100_000_000, BASE))
    told = bench.scan_ee_pose.wait(TIMEOUT_S, lambda message: message.pose.position.x == pytest.approx(0.1))
    assert conversions.stamp_to_ns(told.header.stamp) == start_ns
    assert [message.pose.position.x for message in bench.scan_ee_pose.messages] == pytest.approx([0.3, 0.1])


def test_what_goes_wrong_with_a_scan_is_said_and_the_node_lives_on(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(spin, client, bscan_count=SHAPE[0], spacing_um=SPACING_UM)
    save_volume(tmp_path / "scan.nii", volume)

    def out_of_memory(*arguments: Any, **options: Any) -> bytes:
        raise RuntimeError("CUDA out of memory")

    with monkeypatch.context() as patched:
        patched.setattr(trainer, "InterpolatedField", out_of_memory)
        bench.scan(volume, 1_000_000_000)
        bench.until("C-scan dropped: RuntimeError: CUDA out of memory")
        answer = bench.load(str(tmp_path / "scan.nii"))
        assert answer.result == LoadMap.Response.RESULT_UNDEFINED_FAILURE
        assert not answer.map.data
        bench.until("load_cscan failed: RuntimeError: CUDA out of memory")
    assert not bench.field.messages
    assert not client.call(Trigger, "refit", Trigger.Request(), TIMEOUT_S).success, "no scan has been taken"
    with monkeypatch.context() as patched:
        patched.setattr(trainer, "field_hash", out_of_memory)  # the last thing that a fit does
        bench.load(str(tmp_path / "scan.nii"))
        bench.until("fit failed: CUDA out of memory")
    bench.load(str(tmp_path / "scan.nii"))
    bench.until("field fitted")


def test_the_last_scan_to_come_is_the_last_to_be_published(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file's scan comes first and takes long to make ready; B-scans complete another one meanwhile."""
    bench = Bench(spin, client, bscan_count=SHAPE[0], spacing_um=SPACING_UM)
    path, scan_ns = tmp_path / "scan.nii", 5_000_000_000
    save_volume(path, volume)
    started, assembled = threading.Event(), threading.Event()

    def slow(volume: Volume) -> InterpolatedField:
        if volume.stamp_ns != scan_ns:
            started.set()
            assembled.wait(TIMEOUT_S)
            time.sleep(0.1)  # what the other one would need to overtake
        return InterpolatedField(volume)

    assemble = Trainer._assemble

    def assembling(node: Trainer, *pair: Any) -> Volume | None:
        volume = assemble(node, *pair)
        if volume is not None:
            assembled.set()
        return volume

    monkeypatch.setattr(trainer, "InterpolatedField", slow)
    monkeypatch.setattr(Trainer, "_assemble", assembling)
    with ThreadPoolExecutor() as pool:
        loading = pool.submit(bench.load, str(path))
        assert started.wait(TIMEOUT_S)
        bench.scan(volume, scan_ns)
        assert loading.result(TIMEOUT_S).result == LoadMap.Response.RESULT_SUCCESS
    newest = bench.field.wait(TIMEOUT_S, lambda m: is_neural(m) and conversions.stamp_to_ns(m.header.stamp) == scan_ns)
    order = [conversions.stamp_to_ns(message.header.stamp) == scan_ns for message in bench.field.messages]
    assert order == sorted(order), "no field of the older scan after one of the newer"
    assert bench.field.messages[-1] == newest


def test_bad_cscans_are_reported_and_the_next_good_one_is_fitted(
    spin: Callable[..., Any], client: Any, volume: Volume
) -> None:
    bench = Bench(spin, client, bscan_count=SHAPE[0], spacing_um=SPACING_UM)
    bench.scan(volume, 1_000_000_000, skip=3)
    bench.until("missing: 3")
    voxels = volume.normalized()
    voxels[2, 3, 4] = np.nan
    bench.scan(_unchecked(voxels), 2_000_000_000)
    bench.until("NaN")
    bench.scan(_unchecked(np.full(SHAPE, 7, np.uint8)), 3_000_000_000)
    bench.until("constant")
    bench.scan(volume, 4_000_000_000, frame="camera_link")
    bench.until("camera_link")
    assert not bench.field.messages
    bench.scan(volume, 5_000_000_000)
    assert conversions.stamp_to_ns(bench.field.wait(TIMEOUT_S).header.stamp) == 5_000_000_000


def test_bscans_of_unstated_spacing_are_not_taken(spin: Callable[..., Any], client: Any, volume: Volume) -> None:
    bench = Bench(spin, client)
    bench.scan(volume, 1_000_000_000)
    bench.until("bscan_count and spacing_um")


def test_refit_fits_the_same_scan_again(spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path) -> None:
    bench = Bench(spin, client)
    save_volume(tmp_path / "scan.nii", volume)
    bench.load(str(tmp_path / "scan.nii"))
    first = bench.field.wait(TIMEOUT_S, is_neural)
    assert client.call(Trigger, "refit", Trigger.Request(), TIMEOUT_S).success
    again = bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message is not first)
    assert again.header.stamp == first.header.stamp
    assert not warm(again)


def test_a_warm_start_begins_with_the_last_field(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    bench = Bench(spin, client, warm_start=True)
    save_volume(tmp_path / "scan.nii", volume)
    bench.load(str(tmp_path / "scan.nii"))
    first = bench.field.wait(TIMEOUT_S, is_neural)
    assert not warm(first)
    bench.load(str(tmp_path / "scan.nii"))
    again = bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message is not first)
    assert warm(again)
    levels = SetParameters.Request(parameters=[Parameter("fit.field.grid.levels", value=2).to_parameter_msg()])
    assert client.call(SetParameters, "trainer/set_parameters", levels, TIMEOUT_S).results[0].successful
    bench.load(str(tmp_path / "scan.nii"))
    other = bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message not in (first, again))
    assert not warm(other), "a field of another shape cannot be gone on with"


def test_a_scan_of_another_fine_spacing_is_fitted_anew(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    bench = Bench(spin, client, warm_start=True)
    for name, factor in (("one.nii", 1.0), ("other.nii", 1.0015)):
        # 7.5 nm of 5 um: next to nothing in metres, and yet another grid
        geometry = dataclasses.replace(volume.geometry, spacing_m=(5e-6 * factor,) * 3)
        save_volume(tmp_path / name, dataclasses.replace(volume, geometry=geometry))
    bench.load(str(tmp_path / "one.nii"))
    first = bench.field.wait(TIMEOUT_S, is_neural)
    bench.load(str(tmp_path / "other.nii"))
    assert not warm(bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message is not first))


def test_a_fit_that_diverges_is_published_as_it_last_was_and_said_so(
    spin: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diverged = iter([False] * 29 + [True])
    monkeypatch.setattr(DivergenceGuard, "diverged", lambda self, loss: next(diverged))
    # A batch this large is evaluated every 20 steps.
    bench = Bench(spin, client, fit__steps=60, fit__batch=16384)
    save_volume(tmp_path / "scan.nii", volume)
    bench.load(str(tmp_path / "scan.nii"))
    level, _, values = status.read(bench.until("diverged", "last good state"))
    assert level == status.WARN
    assert (values["state"], values["ended"], values["steps"]) == ("done", "diverged", "20")
    field = loads_field(conversions.field_data(bench.field.wait(TIMEOUT_S, is_neural)))
    assert field.description.training["ended"] == "diverged"


def warm(message: CompressedImage) -> bool:
    return bool(loads_field(conversions.field_data(message)).description.training["warm_start"])


def _unchecked(voxels: np.ndarray) -> Volume:
    """Voxels that a Volume refuses and a scanner may send all the same."""
    volume = Volume.from_array(np.arange(np.prod(SHAPE), dtype=np.uint16).reshape(SHAPE), SPACING_M)
    object.__setattr__(volume, "array", voxels)
    return volume
