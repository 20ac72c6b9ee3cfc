"""The demo from end to end: every link real, on small scans; and the ways in which it can go wrong."""

import base64
import json
import os
import re
import threading

import numpy as np
import pytest

from octn_ros.cli import main
from octn_ros.settings import from_plain
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import save_volume

KEYS = {
    "fit_s", "steps", "psnr_db", "psnr_truth_db", "gaussian_psnr_truth_db", "waypoints", "given_up", "hit_rate",
    "smoothness_mm2", "rms_error_um", "executed", "report",
}  # fmt: skip
SMALL = PhantomConfig(shape=(16, 40, 32), wave_amplitude_m=20e-6)


def pictures_of(path):
    text = path.read_text(encoding="utf-8")
    found = [base64.b64decode(data) for data in re.findall(r'src="data:image/png;base64,([^"]+)"', text)]
    assert all(png.startswith(b"\x89PNG") for png in found)
    return found


def nothing_is_left_running(before):
    assert os.environ.get("OCTN_RENDEZVOUS_PORT") == before
    return [t.name for t in threading.enumerate() if t.name in ("demo graph", "demo", "fit")] == []


def test_from_phantom_to_executed_path(tmp_path, capsys):
    port = os.environ.get("OCTN_RENDEZVOUS_PORT")
    assert main(["demo", "--quick", "--json", "--output", str(tmp_path / "out")]) == 0
    output = capsys.readouterr()
    assert output.out.count("\n") == 1
    values = json.loads(output.out)
    assert values.keys() >= KEYS
    assert values["steps"] == 80
    assert values["psnr_db"] > 26
    assert values["psnr_truth_db"] > values["psnr_db"]
    assert values["gaussian_psnr_truth_db"] > 35
    assert values["hit_rate"] > 0.8
    assert values["rms_error_um"] < 30
    assert values["waypoints"] + values["given_up"] == values["requested"]
    assert values["executed"] == values["waypoints"] > 0.9 * values["requested"]
    assert values["report"] == str(tmp_path / "out" / "report.html")
    assert len(pictures_of(tmp_path / "out" / "report.html")) == 5
    assert "fitting the field" in output.err
    assert nothing_is_left_running(port)


def test_a_recording_has_no_truth(tmp_path, capsys):
    scan = tmp_path / "recorded.nii.gz"
    save_volume(scan, make_phantom(SMALL).volume)
    arguments = ["--volume", str(scan), "--spacing-um", "20", "10", "20", "--output", str(tmp_path)]
    assert main(["demo", "--quick", *arguments]) == 0
    table = " ".join(capsys.readouterr().out.split())
    assert "recorded.nii.gz, 16 x 40 x 32 voxels, 0.62 mm lateral" in table
    assert table.count("unknown for a recording") == 6
    assert "executed shots" in table
    assert len(pictures_of(tmp_path / "report.html")) == 4


def test_bad_arguments_and_files_are_one_line(tmp_path, capsys):
    empty = tmp_path / "empty.nii"
    empty.write_bytes(b"")
    for arguments in (
        ["--spacing-um", "20", "5", "20", "--output", str(tmp_path)],
        ["--volume", str(tmp_path / "missing.nii"), "--output", str(tmp_path)],
        ["--volume", str(empty), "--output", str(tmp_path)],
        ["--output", str(empty / "below")],
    ):
        assert main(["demo", *arguments]) == 2
        output = capsys.readouterr()
        errors = [line for line in output.err.splitlines() if "error" in line]
        assert output.out == ""
        assert len(errors) == 1
        assert errors[0].startswith("octn demo: error: ")


@pytest.fixture
def small_source():
    from octn_ros.demo.source import phantom_source

    return phantom_source(SMALL)


def test_a_scan_that_the_trainer_refuses_ends_the_run(small_source, tmp_path):
    from octn_ros.demo.graph import DemoError
    from octn_ros.demo.run import run_demo

    port = os.environ.get("OCTN_RENDEZVOUS_PORT")
    wrong = {"fit.time_budget_s": 5.0, "bscan_count": 9}
    (tmp_path / "report.html").write_text("of yesterday")
    with pytest.raises(DemoError, match="C-scan dropped"):
        run_demo(small_source, wrong, tmp_path, lambda *shown: None, {})
    assert nothing_is_left_running(port)
    assert not list(tmp_path.iterdir()), "the report of another run is not taken for this one's"


def test_a_graph_that_does_not_answer_in_time_names_the_likely_cause():
    from octn_ros.demo.graph import DemoError, demo_graph

    # isort: split
    from std_srvs.srv import Trigger

    with pytest.raises(DemoError, match=r"service nobody: not there.*busy.*--quick"), demo_graph({}) as client:
        client.call(Trigger, "nobody", Trigger.Request(), 0.1)


def test_a_plan_that_is_refused_ends_the_run_with_the_planners_reason(small_source, monkeypatch):
    from octn_ros.demo import session

    monkeypatch.setattr(session, "centred_rectangle", lambda geometry: ((0.0, 0.0), (0.01, 0.01)))
    with pytest.raises(session.DemoError, match=r"plan_raster refused: .*inside the scan"):
        session.run_session(small_source, {"fit.time_budget_s": 5.0, "fit.steps": 1}, lambda *shown: None)


def test_a_parameter_that_a_node_refuses_ends_the_run(small_source):
    from octn_ros.demo.session import run_session

    port = os.environ.get("OCTN_RENDEZVOUS_PORT")
    with pytest.raises(Exception, match="alpha"):
        run_session(small_source, {"fit.time_budget_s": 5.0, "fit.alpha": 3.0}, lambda *shown: None)
    assert nothing_is_left_running(port)


def test_the_simulator_makes_the_same_phantom(small_source):
    """Seed and configuration are the phantom's identity, also after their way through the node's parameters."""
    plain: dict = {}
    for name, value in small_source.simulator_parameters.items():
        _, *groups, setting = name.split(".")
        place = plain
        for group in groups:
            place = place.setdefault(group, {})
        place[setting] = value
    again = make_phantom(from_plain(PhantomConfig, plain))
    assert np.array_equal(again.volume.array, small_source.volume.array)
