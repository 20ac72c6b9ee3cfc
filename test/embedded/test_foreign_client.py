"""A client without a line of this package uses the graph of real node processes (see docs/embedded.md)."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from std_srvs.srv import Trigger

PROGRAM = Path(__file__).parent / "programs" / "foreign_client.py"
WAIT_SEC = 120.0
FIT_SEC = 180.0  # the first fit on a machine waits for the compiler
SHAPE = (24, 64, 64)
RECTANGLE = (2e-4, 1.5e-4, 6e-4, 5e-4)  # x0, y0, x1, y1 in metres
FIT = ("fit.steps:=50", "fit.batch:=1024", "fit.time_budget_s:=0.0", "fit.field.grid.log2_table_size:=13")
PARAMETERS = {
    "trainer": (f"bscan_count:={SHAPE[0]}", "spacing_um:=[28.0, 14.59, 14.0]", "device:=cpu", *FIT),
    "planner": ("device:=cpu",),
    "simulator": (f"phantom.shape:={list(SHAPE)}", "phantom.surface:=tilted", "time_factor:=50.0"),
}
# What a token of a Jazzy system says of these: kind, type, type hash, quality of service.
PUBLISHED = {
    "/parameter_events": (
        "MP",
        "rcl_interfaces::msg::dds_::ParameterEvent_",
        "RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204",
        "::,1000:,:,:,,",
    ),
    "/octn/execute": (
        "SS",
        "std_srvs::srv::dds_::Trigger_",
        "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
        "::,1000:,:,:,,",
    ),
    "/octn/planner/list_parameters": (
        "SS",
        "rcl_interfaces::srv::dds_::ListParameters_",
        "RIHS01_3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
        "::,1000:,:,:,,",
    ),
}


@pytest.fixture
def graph_client(init):
    """The package's own client, which starts the scan and tells what to compare with."""
    from octn_ros.nodes.client import GraphClient

    init()
    with GraphClient() as client:
        yield client


@pytest.fixture
def scanned(graph_client):
    """Trainer, planner and simulator, each in its process, after a scan was fitted and may be planned on."""
    processes = []
    for name, assignments in PARAMETERS.items():
        arguments = [part for assignment in assignments for part in ("-p", assignment)]
        processes.append(subprocess.Popen([sys.executable, "-m", f"octn_ros.nodes.{name}", "--ros-args", *arguments]))
    try:
        fitted = graph_client.watch(DiagnosticArray, "plan_status")
        graph_client.watch(DiagnosticArray, "fit_progress").wait_matched(WAIT_SEC)
        graph_client.wait_for(
            lambda: graph_client.call(Trigger, "scan", Trigger.Request(), WAIT_SEC).success, WAIT_SEC, "the trainer"
        )
        fitted.wait(FIT_SEC, lambda message: {"ready", "neural"} <= {pair.value for pair in message.status[0].values})
        yield graph_client
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_the_client_has_nothing_of_this_package():
    imported = {
        name.split(".")[0]
        for node in ast.walk(ast.parse(PROGRAM.read_text(encoding="utf-8")))
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }
    assert imported <= {"zenoh", "rosbags"} | sys.stdlib_module_names


@pytest.mark.timeout(2 * FIT_SEC)
def test_it_lists_the_graph_gets_the_latched_field_and_plans(scanned, graph, tmp_path):
    arguments = [graph["ROS_DOMAIN_ID"], graph["OCTN_RENDEZVOUS_PORT"], *map(str, RECTANGLE)]
    ended = subprocess.run(
        [sys.executable, "-I", str(PROGRAM), *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=WAIT_SEC,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)

    tokens = told["graph"]
    assert {t["node"] for t in tokens if t["kind"] == "NN" and t["namespace"] == "/octn"} >= set(PARAMETERS)
    for name, (kind, *rest) in PUBLISHED.items():
        found = [[t["type"], t["hash"], t["qos"]] for t in tokens if t.get("name") == name and t["kind"] == kind]
        assert rest in found, f"{name}: {found}"

    assert told["field"]["format"].startswith("octn-field/safetensors")
    tensors = {name: entry for name, entry in told["field"]["header"].items() if name != "__metadata__"}
    assert tensors
    header_end = told["field"]["size"] - max(entry["data_offsets"][1] for entry in tensors.values())
    assert 8 < header_end < told["field"]["size"]

    path, waypoints = told["path"], scanned.watch(PoseArray, "waypoints").wait(WAIT_SEC)
    assert path["frame"] == waypoints.header.frame_id == "tool0"
    ours = [[p.position.x, p.position.y, p.position.z] for p in waypoints.poses]
    assert len(ours) >= 72  # 8 lines of 9 waypoints or more
    assert path["positions_m"] == ours
