"""`octn demo --record`: the file is read back with the format's own reader, each message decoded by its own schema."""

from __future__ import annotations

import json
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_srvs.srv import Trigger

from octn_ros.cli import main
from octn_ros.demo import recording
from octn_ros.demo.graph import DemoError, demo_graph
from octn_ros.demo.session import Ears
from octn_ros.field import field_hash, loads_field
from octn_ros.nodes import status
from octn_ros.simulation import PhantomConfig

SHAPE = [16, 40, 32]
SMALL = {
    "simulator": {"phantom.shape": SHAPE, "time_factor": 50.0, "audit_path": ""},
    "trainer": {"field_path": "", "bscan_count": SHAPE[0], "spacing_um": [s * 1e6 for s in PhantomConfig().spacing_m]},
}


def messages(path: Path) -> tuple[Any, list[tuple[str, str, Any]]]:
    """Summary of the file, and (topic, type, message) of every message in it."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [(c.topic, s.name, message) for s, c, _, message in reader.iter_decoded_messages()]
        return reader.get_summary(), found


def test_a_demo_is_recorded_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "out.mcap"
    assert main(["demo", "--quick", "--json", "--record", str(path), "--output", str(tmp_path)]) == 0
    result = json.loads(capsys.readouterr().out)
    summary, found = messages(path)
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    assert summary.statistics.message_count == len(found)
    topics = {channel.topic for channel in summary.channels.values()}
    assert {"/octn/field", "/octn/surface", "/octn/plan_markers", "/tf", "/diagnostics"} < topics
    offered = {c.topic: yaml.safe_load(c.metadata["offered_qos_profiles"])[0] for c in summary.channels.values()}
    assert {kept for kept, qos in offered.items() if qos["durability"] == DurabilityPolicy.TRANSIENT_LOCAL} > {
        f"/octn/{name}" for name in ("enface", "field", "surface", "waypoints_oct", "path", "plan_markers")
    }
    assert offered["/tf"]["durability"] == offered["/octn/bscan"]["durability"] == DurabilityPolicy.VOLATILE
    assert {qos["reliability"] for qos in offered.values()} == {ReliabilityPolicy.RELIABLE}
    counts = Counter(topic for topic, _, _ in found)
    assert counts["/octn/bscan"] == counts["/octn/bscan_pose"] == result["bscans"]
    assert counts["/tf_static"] == 1  # latched before the recorder came
    assert counts["/tf"] > 10
    assert counts["/octn/slice"] == 1
    assert counts["/octn/band"] >= 1
    of = {topic: [message for name, _, message in found if name == topic] for topic in counts}
    # What the demo says of its run lies in the file: the field by its hash, each waypoint, each B-scan's grey levels.
    assert field_hash(bytes(of["/octn/field"][-1].data)) == result["field_hash"]
    assert loads_field(bytes(of["/octn/field"][-1].data)).geometry.shape[0] == result["bscans"]
    assert len(of["/octn/waypoints"][-1].poses) == of["/octn/tool_path"][-1].width == result["waypoints"]
    assert of["/octn/slice"][0].encoding == "32FC1"
    assert of["/octn/band"][-1].width > 0
    image = of["/octn/bscan"][3]
    assert np.frombuffer(bytes(image.data), np.uint8).size == image.step * image.height
    children = {transform.child_frame_id for transform in of["/tf_static"][0].transforms}
    assert children == {"oct_optical_frame", "laser_frame", "oct_bscan_frame"}
    states = [{pair.key: pair.value for pair in m.status[0].values}["state"] for m in of["/octn/execution_status"]]
    assert states[-1] == "done"
    assert [thread.name for thread in threading.enumerate() if thread.name == "recorder"] == []


def test_a_place_that_cannot_be_written_is_said_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "missing" / "out.mcap"
    assert main(["demo", "--quick", "--record", str(path), "--output", str(tmp_path)]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert line.startswith(f"octn demo: error: {path}: cannot write the recording: No such file")


@pytest.mark.parametrize("begun", [True, False])
def test_a_demo_that_fails_says_where_its_recording_lies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, begun: bool
) -> None:
    path = tmp_path / "out.mcap"
    path.write_bytes(b"of yesterday")

    def fails(*_: Any) -> None:
        if begun:
            path.write_bytes(b"of now")
        raise DemoError("the graph stood still")

    monkeypatch.setattr("octn_ros.demo.run.run_demo", fails)
    assert main(["demo", "--quick", "--record", str(path), "--output", str(tmp_path)]) == 2
    said = "".join(capsys.readouterr().err.split())
    assert (f"Recordinguptothen:{path}" in said) is begun
    assert "thegraphstoodstill" in said


def test_a_full_disk_ends_the_recording_and_not_the_demo(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full, a disk that is always full")
    said = []

    def demo() -> None:
        with demo_graph(SMALL, Path("/dev/full")) as client:
            ears = Ears(client)
            assert client.call(Trigger, "scan", Trigger.Request(), 30).success
            ears.fit_progress.wait(60, lambda report: status.read(report)[2].get("state") == "fitting")
            said.append("went on")

    with pytest.raises(recording.RecordingError, match="No space left on device; it ends after"):
        demo()
    assert said == ["went on"]


def test_without_the_package_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with (
        pytest.raises(recording.RecordingError, match=r"pip install 'octn_ros\[record\]'"),
        demo_graph(SMALL, tmp_path / "out.mcap"),
    ):
        raise AssertionError("the demo began")
    assert not (tmp_path / "out.mcap").exists()
