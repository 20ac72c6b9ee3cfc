"""The scanner and the arm of examples/, with the real trainer and planner: from `scan` to the last waypoint."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from nav_msgs.srv import GetPlan
from std_srvs.srv import Trigger

from octn_ros.nodes import conversions, status
from octn_ros.nodes.planner import Planner
from octn_ros.nodes.trainer import Trainer

EXAMPLES = Path(__file__).parents[1] / "examples"
WAIT_S = 60.0
SPACING_UM = [28.0, 14.59, 14.0]


def example(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_scanner_and_an_arm_of_sixty_lines_are_enough(spin: Callable[..., Any], client: Any) -> None:
    scanner, arm = example("minimal_scanner"), example("minimal_arm")
    progress = client.watch(DiagnosticArray, "fit_progress")
    planner = client.watch(DiagnosticArray, "plan_status")
    base = client.watch(PoseArray, "waypoints_base")
    fit = {"fit__steps": 60, "fit__time_budget_s": 0.0, "fit__field__grid__log2_table_size": 12}
    spin(Trainer, device="cpu", bscan_count=scanner.BSCANS, spacing_um=SPACING_UM, field_path="", **fit)
    spin(Planner, device="cpu")
    scanning, moving = spin(lambda **_: scanner.MinimalScanner()), spin(lambda **_: arm.MinimalArm())
    for publisher in (scanning._image, scanning._pose, moving._ee_pose):
        client.wait_for(lambda publisher=publisher: publisher.get_subscription_count() > 0, WAIT_S, "trainer")
    refused = client.call(Trigger, "execute", Trigger.Request(), WAIT_S)
    assert (refused.success, refused.message) == (False, "there is no plan")

    assert client.call(Trigger, "scan", Trigger.Request(), WAIT_S).success
    progress.wait(WAIT_S, lambda report: status.read(report)[2].get("state") == "done")
    planner.wait(WAIT_S, lambda report: status.read(report)[2].get("field_kind") == "neural")
    request = GetPlan.Request(tolerance=100e-6)
    for pose, corner in ((request.start, 0.15e-3), (request.goal, 0.5e-3)):
        pose.header.frame_id = "oct_optical_frame"
        pose.pose.position.x = pose.pose.position.y = corner
    path = client.call(GetPlan, "plan_raster", request, WAIT_S).plan
    assert path.poses, status.read(planner.messages[-1])[1]
    # The layer begins at row 22, which is the depth of every waypoint in the OCT frame.
    oct2ee = moving._calibration.oct2ee
    places = conversions.poses_to_matrices([pose.pose for pose in path.poses])[:, :3, 3]
    depth_m = ((places - oct2ee[:3, 3]) @ oct2ee[:3, :3])[:, 2]
    np.testing.assert_allclose(depth_m, 21.5 * 14.59e-6, atol=20e-6)

    planned = base.wait(WAIT_S, lambda message: len(message.poses) == len(path.poses))
    client.wait_for(lambda: len(moving._waypoints.poses) == moving._tool_path.width == len(path.poses), WAIT_S, "arm")
    done = client.call(Trigger, "execute", Trigger.Request(), WAIT_S)
    assert done.success, done.message
    expected = conversions.poses_to_matrices(planned.poses)[:, :3, 3]
    np.testing.assert_allclose(np.array(moving.reached), expected, atol=1e-9)


def test_the_examples_run_as_programs_and_end_in_order(client: Any) -> None:
    programs = [subprocess.Popen([sys.executable, str(EXAMPLES / f"minimal_{name}.py")]) for name in ("scanner", "arm")]
    try:
        scanned = client.call(Trigger, "scan", Trigger.Request(), WAIT_S)
        assert (scanned.success, scanned.message) == (True, "scanning 32 B-scans")
        assert client.call(Trigger, "execute", Trigger.Request(), WAIT_S).message == "there is no plan"
        for program in programs:
            program.send_signal(signal.SIGINT)
        assert [program.wait(WAIT_S) for program in programs] == [0, 0]
    finally:
        for program in programs:
            if program.poll() is None:
                program.kill()
                program.wait()
