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
from nav_msgs.srv import LoadMap
from PIL import Image as PngImage
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage

from octn_ros.field import field_hash, loads_field
from octn_ros.nodes import conversions, field_fitter, status
from octn_ros.nodes.trainer import Trainer
from octn_ros.planning import from_translation_quaternion
from octn_ros.training.divergence import DivergenceGuard
from octn_ros.volume import Volume, save_volume
from octn_ros.volume.assembly import CScanAssembler

TIMEOUT_S = 120.0
SHAPE = (6, 24, 16)
SPACING_UM = [28.0, 14.59, 14.0]
SPACING_M = tuple(s * 1e-6 for s in SPACING_UM)
BASE = "base_link"


def kind_of(message: CompressedImage) -> str:
    return loads_field(conversions.field_data(message)).kind


def is_neural(message: CompressedImage) -> bool:
    return kind_of(message) == "neural"


def test_a_file_becomes_an_en_face_view_and_a_field_at_once_and_then_a_fitted_one(
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path
) -> None:
    bench = trainer_bench()
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
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path
) -> None:
    path = tmp_path / "unstated.nii"
    nibabel.save(nibabel.Nifti1Image(volume.array, np.eye(4)), path)
    bench = trainer_bench()
    assert bench.load(str(path)).result == LoadMap.Response.RESULT_INVALID_MAP_DATA
    bench.until("load_cscan refused", "spacing")
    assert bench.set("spacing_um", SPACING_UM).successful
    answer = bench.load(str(path))
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    assert answer.map.info.resolution == pytest.approx(14e-6)


def test_a_folder_of_images_is_a_scan_too(trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path) -> None:
    for number, bscan in enumerate(volume.array):
        PngImage.fromarray(bscan).save(tmp_path / f"bscan_{number}.png")
    bench = trainer_bench(spacing_um=SPACING_UM)
    assert bench.load(tmp_path.as_uri()).result == LoadMap.Response.RESULT_SUCCESS
    assert loads_field(conversions.field_data(bench.field.wait(TIMEOUT_S))).geometry.shape == SHAPE


def test_files_that_cannot_be_used_are_refused_in_words(
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path
) -> None:
    bench = trainer_bench()
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


def test_bscans_become_a_field_with_the_pose_of_the_arm(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(bscan_count=SHAPE[0], spacing_um=SPACING_UM)
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
    trainer_bench: Callable[..., Any], volume: Volume
) -> None:
    bench = trainer_bench(bscan_count=SHAPE[0], spacing_um=SPACING_UM)
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
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = trainer_bench(bscan_count=SHAPE[0], spacing_um=SPACING_UM)
    save_volume(tmp_path / "scan.nii", volume)

    def out_of_memory(*arguments: Any, **options: Any) -> bytes:
        raise RuntimeError("CUDA out of memory")

    with monkeypatch.context() as patched:
        patched.setattr(conversions, "with_field_message", out_of_memory)
        bench.scan(volume, 1_000_000_000)
        bench.until("C-scan dropped: RuntimeError: CUDA out of memory")
        answer = bench.load(str(tmp_path / "scan.nii"))
        assert answer.result == LoadMap.Response.RESULT_UNDEFINED_FAILURE
        assert not answer.map.data
        bench.until("load_cscan failed: RuntimeError: CUDA out of memory")
    assert not bench.field.messages
    assert not bench.trigger("refit").success, "no scan has been taken"
    with monkeypatch.context() as patched:
        patched.setattr(field_fitter, "dumps_field", out_of_memory)  # once the fit is done
        bench.load(str(tmp_path / "scan.nii"))
        bench.until("fit failed: CUDA out of memory")
    bench.load(str(tmp_path / "scan.nii"))
    bench.until("field fitted")


def test_the_last_scan_to_come_is_the_last_to_be_published(
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file's scan comes first and takes long to make ready; B-scans complete another one meanwhile."""
    bench = trainer_bench(bscan_count=SHAPE[0], spacing_um=SPACING_UM)
    path, scan_ns = tmp_path / "scan.nii", 5_000_000_000
    save_volume(path, volume)
    started, assembled = threading.Event(), threading.Event()

    def slow(volume: Volume) -> Any:
        if volume.stamp_ns != scan_ns:
            started.set()
            assembled.wait(TIMEOUT_S)
            time.sleep(0.1)  # what the other one would need to overtake
        return with_field_message(volume)

    with_field_message, add = conversions.with_field_message, CScanAssembler.add

    def adding(assembler: CScanAssembler, *bscan: Any) -> Volume | None:
        volume = add(assembler, *bscan)
        if volume is not None:
            assembled.set()
        return volume

    monkeypatch.setattr(conversions, "with_field_message", slow)
    monkeypatch.setattr(CScanAssembler, "add", adding)
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
    trainer_bench: Callable[..., Any], volume: Volume
) -> None:
    bench = trainer_bench(bscan_count=SHAPE[0], spacing_um=SPACING_UM)
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


def test_bscans_of_unstated_spacing_are_not_taken(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench()
    bench.scan(volume, 1_000_000_000)
    bench.until("bscan_count and spacing_um")


def test_refit_fits_the_same_scan_again(trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path) -> None:
    bench = trainer_bench()
    save_volume(tmp_path / "scan.nii", volume)
    bench.load(str(tmp_path / "scan.nii"))
    first = bench.field.wait(TIMEOUT_S, is_neural)
    assert bench.trigger("refit").success
    again = bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message is not first)
    assert again.header.stamp == first.header.stamp
    assert not warm(again)


def test_a_warm_start_begins_with_the_last_field(
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path
) -> None:
    bench = trainer_bench(warm_start=True)
    save_volume(tmp_path / "scan.nii", volume)
    bench.load(str(tmp_path / "scan.nii"))
    first = bench.field.wait(TIMEOUT_S, is_neural)
    assert not warm(first)
    bench.load(str(tmp_path / "scan.nii"))
    again = bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message is not first)
    assert warm(again)
    assert bench.set("fit.field.grid.levels", 2).successful
    bench.load(str(tmp_path / "scan.nii"))
    other = bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message not in (first, again))
    assert not warm(other), "a field of another shape cannot be gone on with"


def test_a_scan_of_another_fine_spacing_is_fitted_anew(
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path
) -> None:
    bench = trainer_bench(warm_start=True)
    for name, factor in (("one.nii", 1.0), ("other.nii", 1.0015)):
        # 7.5 nm of 5 um: next to nothing in metres, and yet another grid
        geometry = dataclasses.replace(volume.geometry, spacing_m=(5e-6 * factor,) * 3)
        save_volume(tmp_path / name, dataclasses.replace(volume, geometry=geometry))
    bench.load(str(tmp_path / "one.nii"))
    first = bench.field.wait(TIMEOUT_S, is_neural)
    bench.load(str(tmp_path / "other.nii"))
    assert not warm(bench.field.wait(TIMEOUT_S, lambda message: is_neural(message) and message is not first))


def test_a_fit_that_diverges_is_published_as_it_last_was_and_said_so(
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diverged = iter([False] * 29 + [True])
    monkeypatch.setattr(DivergenceGuard, "diverged", lambda self, loss: next(diverged))
    # A batch this large is evaluated every 20 steps.
    bench = trainer_bench(fit__steps=60, fit__batch=16384)
    save_volume(tmp_path / "scan.nii", volume)
    bench.load(str(tmp_path / "scan.nii"))
    level, _, values = status.read(bench.until("diverged", "last good state"))
    assert level == status.WARN
    assert (values["state"], values["ended"], values["steps"]) == ("done", "diverged", "20")
    field = loads_field(conversions.field_data(bench.field.wait(TIMEOUT_S, is_neural)))
    assert field.description.training["ended"] == "diverged"


def test_a_fit_that_outlives_its_node_ends_without_an_error(
    ros: None, volume: Volume, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit, begun, go, faults = field_fitter.fit, threading.Event(), threading.Event(), []

    def late(*arguments: Any, **options: Any) -> Any:
        begun.set()
        assert go.wait(TIMEOUT_S)
        return fit(*arguments, **options)

    monkeypatch.setattr(field_fitter, "fit", late)
    monkeypatch.setattr(threading, "excepthook", lambda arguments: faults.append(arguments.exc_value))
    trainer = Trainer(parameter_overrides=[Parameter("device", value="cpu")])
    health, worker = trainer._diagnostics, trainer._fitter._worker._thread
    trainer._accept(volume)
    assert begun.wait(TIMEOUT_S)
    trainer.destroy_node()  # waits a little and no longer
    go.set()
    worker.join(TIMEOUT_S)
    assert (worker.is_alive(), faults, health._errors) == (False, [], 0)


def warm(message: CompressedImage) -> bool:
    return bool(loads_field(conversions.field_data(message)).description.training["warm_start"])


def _unchecked(voxels: np.ndarray) -> Volume:
    """Voxels that a Volume refuses and a scanner may send all the same."""
    volume = Volume.from_array(np.arange(np.prod(SHAPE), dtype=np.uint16).reshape(SHAPE), SPACING_M)
    object.__setattr__(volume, "array", voxels)
    return volume
