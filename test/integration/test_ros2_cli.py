"""Everything by the `ros2` command line, as a user without a line of code does it: needs an installed ROS 2."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import save_volume

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("ros2") is None, reason="ROS 2 is not installed: there is no ros2 command line"),
]

COMMAND_SEC = 60.0
START_SEC = 180.0
FIT_SEC = 180.0  # the first fit on a machine waits for the compiler
EXIT_SEC = 20.0
STEP_SEC = 0.5
FOLLOW_SEC = 5.0  # three to start the command; where it takes longer it is asked again
NODES = ("planner", "query", "simulator", "trainer")
CORNERS = "start: {{header: {{frame_id: oct_optical_frame}}, pose: {{position: {{x: {0}, y: {1}}}}}}}, \
goal: {{header: {{frame_id: oct_optical_frame}}, pose: {{position: {{x: {2}, y: {3}}}}}}}"
INSIDE = CORNERS.format(2e-4, 1.5e-4, 6e-4, 5e-4)
OUTSIDE = CORNERS.format(1.0, 1.0, 2.0, 2.0)
PARAMETERS = {
    "/octn/trainer": {
        "fit.steps": 100,
        "fit.batch": 2048,
        "fit.time_budget_s": 0.0,
        "fit.field.grid.log2_table_size": 13,
    }
}
TYPES = {
    "abort": "std_srvs/srv/Trigger",
    "cancel": "std_srvs/srv/Trigger",
    "enable_laser": "std_srvs/srv/SetBool",
    "execute": "std_srvs/srv/Trigger",
    "load_cscan": "nav_msgs/srv/LoadMap",
    "plan_raster": "nav_msgs/srv/GetPlan",
    "query_band": "std_srvs/srv/Trigger",
    "query_slice": "nav_msgs/srv/LoadMap",
    "query_surface": "nav_msgs/srv/GetPlan",
    "refit": "std_srvs/srv/Trigger",
    "replan": "std_srvs/srv/Trigger",
    "scan": "std_srvs/srv/Trigger",
}


def ros2(*arguments: str, fails: bool = False) -> str:
    """What a ros2 command prints; it has to end by itself, and well unless it `fails`."""
    command = ["ros2", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=COMMAND_SEC, check=False)
    assert fails == (ended.returncode != 0), f"{' '.join(command)}: {ended.stdout}{ended.stderr}"
    return ended.stdout + ended.stderr


def call(name: str, request: str = "{}") -> str:
    """The response of a service as `ros2 service call` prints it."""
    return ros2("service", "call", f"/octn/{name}", TYPES[name], request).partition("response:\n")[2]


def echo(topic: str, *options: str) -> str:
    """The latched message of a topic."""
    latched = ("--qos-durability", "transient_local", "--qos-reliability", "reliable")
    return ros2("topic", "echo", "--once", "--full-length", *latched, *options, topic)


def newest(topic: str) -> str:
    """The last report of a topic that keeps several: Fast DDS hands them all to a late joiner, the oldest first."""
    command = ["ros2", "topic", "echo", "--full-length", topic]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as follows:
        time.sleep(FOLLOW_SEC)
        follows.send_signal(signal.SIGINT)
        said, _ = follows.communicate(timeout=COMMAND_SEC)
    whole = said.split("---\n")[:-1]
    return whole[-1] if whole else ""


def until(happened: Callable[[], bool], sec: float, what: str) -> None:
    end = time.monotonic() + sec
    while not happened():
        assert time.monotonic() < end, f"{what} within {sec:g} s"
        time.sleep(STEP_SEC)


@pytest.fixture(scope="module")
def launched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """`ros2 launch octn_ros demo.launch.py` on a tiny phantom, scanned and fitted."""
    folder = tmp_path_factory.mktemp("cli")
    save_volume(folder / "scan.nii.gz", make_phantom(PhantomConfig(shape=(24, 64, 64), surface="tilted")).volume)
    settings = {node: {"ros__parameters": values} for node, values in PARAMETERS.items()}
    (folder / "parameters.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    arguments = [f"volume:={folder / 'scan.nii.gz'}", f"params_file:={folder / 'parameters.yaml'}", "device:=cpu"]
    with (folder / "launch.log").open("w") as log:
        process = subprocess.Popen(
            ["ros2", "launch", "octn_ros", "demo.launch.py", *arguments],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "ROS_HOME": str(folder)},
            start_new_session=True,
        )
        try:
            until(lambda: {f"/octn/{n}" for n in NODES} <= set(ros2("node", "list").split()), START_SEC, "all nodes")
            until(lambda: "success=True" in call("scan"), COMMAND_SEC, "a scan")
            until(lambda: "field_kind\n    value: neural" in echo("/octn/plan_status"), FIT_SEC, "a fitted field")
            yield
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does at Ctrl-C
            process.wait(EXIT_SEC)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            ros2("daemon", "stop")
    text = (folder / "launch.log").read_text(encoding="utf-8")
    assert "Traceback" not in text, text
    assert text.count("process has finished cleanly") == len(NODES), text


def test_every_service_is_there_with_its_type(launched: None) -> None:
    listed = re.findall(r"^/octn/(\w+) \[(.+)\]$", ros2("service", "list", "-t"), re.MULTILINE)
    assert dict(listed) == TYPES
    for kind in set(TYPES.values()):
        assert "---" in ros2("interface", "show", kind)


def test_topics_are_there_with_their_types(launched: None) -> None:
    text = ros2("topic", "list", "-t")
    for line in (
        "/octn/field [sensor_msgs/msg/CompressedImage]",
        "/octn/waypoints [geometry_msgs/msg/PoseArray]",
        "/octn/tool_path [sensor_msgs/msg/PointCloud2]",
        "/octn/bscan [sensor_msgs/msg/Image]",
        "/octn/surface [sensor_msgs/msg/PointCloud2]",
        "/tf_static [tf2_msgs/msg/TFMessage]",
        "/diagnostics [diagnostic_msgs/msg/DiagnosticArray]",
    ):
        assert line in text.splitlines()
    assert "Durability: TRANSIENT_LOCAL" in ros2("topic", "info", "--verbose", "/octn/field")


def test_what_is_latched_can_be_echoed(launched: None) -> None:
    assert "octn-field/safetensors" in echo("/octn/field", "--field", "format")
    assert "frame_id: base_link" in echo("/octn/scan_ee_pose")
    assert "resolution" in echo("/octn/enface", "--field", "info")
    assert "name='z'" in echo("/octn/surface", "--field", "fields")
    assert "oct_optical_frame" in echo("/tf_static")
    assert "octn" in ros2("topic", "echo", "--once", "/diagnostics")


def test_from_a_plan_to_its_execution(launched: None) -> None:
    path = call("plan_raster", f"{{{INSIDE}, tolerance: 0.00005}}")
    count = path.count("PoseStamped(")
    assert count >= 72  # 8 lines of 9 waypoints or more
    assert "tool0" in path
    assert echo("/octn/waypoints").count("orientation:") == count
    assert "frame_id: tool0" in echo("/octn/tool_path", "--field", "header")
    until(lambda: "staged" in newest("/octn/execution_status"), COMMAND_SEC, "the plan staged")
    assert "success=False" in call("execute"), "the laser is not enabled"
    assert "success=True" in call("enable_laser", "{data: true}")
    answer = call("execute")
    assert "success=True" in answer, answer
    reports: list[str] = []

    def done() -> bool:
        reports.append(newest("/octn/execution_status"))
        return "value: done" in reports[-1]

    until(done, COMMAND_SEC, "all shots")
    assert f"value: '{count}'" in reports[-1]
    assert "success=True" in call("abort")


def test_a_refused_plan_is_empty_and_its_reason_is_on_the_status_topic(launched: None) -> None:
    assert "poses=[]" in call("plan_raster", f"{{{OUTSIDE}, tolerance: 0.00005}}")
    assert "refused" in echo("/octn/plan_status")


def test_replan_goes_by_the_parameters(launched: None) -> None:
    answer = call("replan")
    assert re.search(r"success=(True|False), message='.+'", answer), answer


def test_queries(launched: None) -> None:
    assert call("query_surface", f"{{{INSIDE}, tolerance: 0.0001}}").count("PoseStamped(") >= 5
    assert "result=0" in call("query_slice", "{map_url: 'bscan:12'}")
    assert "result=0" not in call("query_slice", "{map_url: 'sausage:1'}")
    assert "success=True" in call("query_band")


def test_the_trainer_refuses_what_is_not_there_and_fits_again(launched: None) -> None:
    assert "result=0" not in call("load_cscan", "{map_url: 'file:///nowhere/scan.nii'}")
    assert "success=True" in call("refit")
    assert re.search(r"success=(True|False), message='.+'", call("cancel"))


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_is_listed_and_described(launched: None, node: str) -> None:
    names = [name.strip() for name in ros2("param", "list", f"/octn/{node}").splitlines()]
    told = ros2("param", "describe", f"/octn/{node}", *names)
    assert told.count("Parameter name:") == len(names)
    own = [name for name in names if not name.startswith("use_sim_time") and "type_description" not in name]
    assert len(own) >= 5
    blocks = {block.split("\n", 1)[0].strip(): block for block in told.split("Parameter name:")[1:]}
    for name in own:
        assert re.search(r"Description: \S", blocks[name]), f"{name} is not described"
    dumped = yaml.safe_load(ros2("param", "dump", f"/octn/{node}"))[f"/octn/{node}"]["ros__parameters"]
    assert dumped


def test_parameters_are_set_and_what_cannot_be_is_refused_with_the_reason(launched: None) -> None:
    name = "raster.line_spacing_m"
    assert "successful" in ros2("param", "set", "/octn/planner", name, "0.00006")
    assert "6e-05" in ros2("param", "get", "/octn/planner", name)
    assert re.search("failed.*-1", ros2("param", "set", "/octn/planner", name, "-1.0"), re.DOTALL)
    assert "6e-05" in ros2("param", "get", "/octn/planner", name)


@pytest.mark.parametrize("node", NODES)
def test_a_node_tells_what_it_offers(launched: None, node: str) -> None:
    text = ros2("node", "info", f"/octn/{node}")
    for heading in ("Subscribers:", "Publishers:", "Service Servers:"):
        assert heading in text


@pytest.mark.parametrize("node", NODES)
def test_ros2_run_starts_a_node_and_reports_a_wrong_parameter(node: str) -> None:
    assert node in ros2("pkg", "executables", "octn_ros")
    setting = {"trainer": "bscan_count:=-1", "simulator": "volume_file:=/nowhere/scan.nii"}.get(node, "device:=abacus")
    text = ros2("run", "octn_ros", node, "--ros-args", "-p", setting, fails=True)
    assert setting.split(":=")[1] in text
    assert "Traceback" not in text


def test_the_launch_files_tell_their_arguments() -> None:
    for file in ("octn.launch.py", "demo.launch.py"):
        text = ros2("launch", "octn_ros", file, "--show-args")
        assert all(f"'{name}':" in text for name in ("namespace", "params_file", "calibration", "device", "preset"))
    assert Path(ros2("pkg", "prefix", "octn_ros").strip()).is_dir()
