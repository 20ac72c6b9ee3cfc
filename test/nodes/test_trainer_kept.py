"""A trainer that starts again: it publishes the field that the one before it kept."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import LoadMap
from sensor_msgs.msg import CompressedImage

from octn_ros.field import field_hash, loads_field
from octn_ros.nodes import conversions, status
from octn_ros.nodes.field_store import FieldStore
from octn_ros.nodes.trainer import Trainer
from octn_ros.planning import from_translation_quaternion
from octn_ros.volume import Volume, save_volume

STAMP_NS = 5_000_000_000
BASE = "base_link"
EE2BASE = from_translation_quaternion((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))


def neural(message: CompressedImage) -> bool:
    return loads_field(conversions.field_data(message)).kind == "neural"


class Kept:
    """A field that a trainer has fitted, published and kept."""

    def __init__(self, trainer_bench: Callable[..., Any], volume: Volume, path: Path) -> None:
        self.path = path
        self.bench = trainer_bench(field_path=str(path), bscan_count=6, spacing_um=[0.0, 14.59, 14.0])
        bench = self.bench
        bench.ee_pose.publish(conversions.matrix_to_pose_stamped(EE2BASE, STAMP_NS, BASE))
        bench.scan(volume, STAMP_NS)
        self.field = bench.field.wait(bench.timeout_s, neural)
        self.fit = bench.values("done")
        self.pose = bench.scan_ee_pose.wait(bench.timeout_s)
        self.enface = bench.enface.wait(bench.timeout_s)


@pytest.fixture
def kept(trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path) -> Kept:
    return Kept(trainer_bench, volume, tmp_path / "kept.zip")


@pytest.fixture
def again(spin: Callable[..., Any], tmp_path: Path) -> Callable[..., Any]:
    """Start a second trainer, in a namespace of its own, with the kept field of the first."""
    shared = {"field_path": str(tmp_path / "kept.zip"), "device": "cpu", "data_root": str(tmp_path)}
    small = {"fit__steps": 5, "fit__batch": 256, "fit__time_budget_s": 0.0, "fit__field__grid__log2_table_size": 10}
    return lambda **more: spin(functools.partial(Trainer, namespace="again"), **(shared | small | more))


def test_a_restarted_trainer_publishes_the_kept_field_with_all_that_belongs_to_it(
    kept: Kept, again: Callable[..., Any], client: Any
) -> None:
    again()
    wait_s = kept.bench.timeout_s
    assert client.watch(CompressedImage, "/again/field").wait(wait_s) == kept.field
    assert client.watch(PoseStamped, "/again/scan_ee_pose").wait(wait_s) == kept.pose
    assert client.watch(OccupancyGrid, "/again/enface").wait(wait_s) == kept.enface
    level, words, values = status.read(client.watch(DiagnosticArray, "/again/fit_progress").wait(wait_s))
    assert level == status.WARN
    assert re.search(r"is published again; its scan is \d{10,} s old, and holds until a new one comes", words)
    assert (values["state"], values["field_kind"]) == ("restored", "neural")
    assert values["field_hash"] == field_hash(conversions.field_data(kept.field)) == kept.fit["field_hash"]
    assert float(values["age_s"]) > 1e9, "the scan's own stamp, some seconds after 1970"
    for figure in ("psnr_db", "float16_rms", "float16_largest", "steps"):
        assert float(values[figure]) == pytest.approx(float(kept.fit[figure]), rel=1e-6)


def test_the_first_trainer_of_all_has_nothing_to_publish(again: Callable[..., Any], client: Any) -> None:
    node = again()
    assert node._present.known is None


def test_a_new_scan_takes_the_place_of_the_kept_field(
    kept: Kept, again: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    again(warm_start=True)
    field = client.watch(CompressedImage, "/again/field")
    progress = client.watch(DiagnosticArray, "/again/fit_progress")
    save_volume(tmp_path / "scan.nii", volume)
    request = LoadMap.Request(map_url="scan.nii")
    answer = client.call(LoadMap, "/again/load_cscan", request, kept.bench.timeout_s)
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    fitted = field.wait(kept.bench.timeout_s, lambda message: message != kept.field and neural(message))
    assert loads_field(conversions.field_data(fitted)).description.training["warm_start"], "from the kept one"
    done = progress.wait(kept.bench.timeout_s, lambda message: status.read(message)[2]["state"] == "done")
    assert status.read(done)[2]["field_hash"] == field_hash(conversions.field_data(fitted))


def test_a_pose_that_comes_late_is_kept_too(
    trainer_bench: Callable[..., Any], again: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path
) -> None:
    bench = trainer_bench(field_path=str(tmp_path / "kept.zip"), bscan_count=6, spacing_um=[28.0, 14.59, 14.0])
    bench.scan(volume, STAMP_NS)
    bench.values("done")
    bench.ee_pose.publish(conversions.matrix_to_pose_stamped(EE2BASE, STAMP_NS + 1000, BASE))
    pose = bench.scan_ee_pose.wait(bench.timeout_s)
    store = FieldStore(tmp_path / "kept.zip")
    client.wait_for(lambda: (store.load() or bench).pose is not None, bench.timeout_s, "the pose on disk")
    again()
    assert client.watch(PoseStamped, "/again/scan_ee_pose").wait(bench.timeout_s) == pose


@pytest.mark.parametrize("content", [b"", b"not a field", None])
def test_a_damaged_kept_field_is_reported_and_the_trainer_lives(
    kept: Kept, again: Callable[..., Any], client: Any, volume: Volume, tmp_path: Path, content: bytes | None
) -> None:
    whole = kept.path.read_bytes()
    kept.path.write_bytes(whole[: len(whole) // 2] if content is None else content)
    again()
    progress = client.watch(DiagnosticArray, "/again/fit_progress")
    level, words, values = status.read(progress.wait(kept.bench.timeout_s))
    assert level == status.WARN
    assert values["state"] == "not restored"
    assert "kept.zip: the kept field is damaged" in words
    save_volume(tmp_path / "scan.nii", volume)
    request = LoadMap.Request(map_url="scan.nii")
    client.call(LoadMap, "/again/load_cscan", request, kept.bench.timeout_s)
    progress.wait(kept.bench.timeout_s, lambda message: status.read(message)[2]["state"] == "done")
    found = FieldStore(kept.path).load()
    assert found is not None, "the damaged one has been replaced"


def test_a_field_that_cannot_be_kept_is_published_all_the_same_and_said_so(
    trainer_bench: Callable[..., Any], volume: Volume, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    bench = trainer_bench(field_path=str(tmp_path / "file" / "kept.zip"), bscan_count=6, spacing_um=[28.0, 14.59, 14.0])
    bench.scan(volume, STAMP_NS)
    bench.field.wait(bench.timeout_s, neural)
    level, words, _ = status.read(bench.until("field fitted"))
    assert level == status.WARN
    assert "a restarted trainer will not have it" in words


def test_nothing_is_kept_where_it_is_off(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(field_path="", bscan_count=6, spacing_um=[28.0, 14.59, 14.0])
    bench.scan(volume, STAMP_NS)
    bench.values("done")
    assert not Path(os.environ["ROS_HOME"], "octn_ros").exists()


def test_by_default_it_is_kept_under_the_ros_home(trainer_bench: Callable[..., Any], volume: Volume) -> None:
    bench = trainer_bench(bscan_count=6, spacing_um=[28.0, 14.59, 14.0])
    bench.scan(volume, STAMP_NS)
    bench.values("done")
    found = FieldStore(Path(os.environ["ROS_HOME"], "octn_ros", "octn.trainer.field.zip")).load()
    assert found is not None
    assert found.stamp_ns == STAMP_NS
