"""The four nodes in one process: scan, fit, plan, execute, and what happens when something is asked that cannot be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, PointCloud2
from std_srvs.srv import SetBool, Trigger

from octn_ros.field import field_hash
from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.planner import Planner
from octn_ros.nodes.query import Query
from octn_ros.nodes.simulator import Simulator
from octn_ros.nodes.trainer import Trainer
from octn_ros.planning import load_calibration
from octn_ros.resources import config_path
from octn_ros.simulation import PhantomConfig, make_phantom

SHAPE = (24, 64, 64)
SPACING_UM = [28.0, 14.59, 14.0]
ERROR = b"\x02"
SERVICE_TIMEOUT_S = 120.0
FIT_TIMEOUT_S = 180.0
EXECUTION_TIMEOUT_S = 120.0
ATTEMPTS = 1000


class Graph:
    """All nodes, and a client with what was heard on the topics."""

    def __init__(self, spin: Callable[..., Any], client: Any, **simulator: Any) -> None:
        self.client = client
        self.fit_progress = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
        self.field = client.watch(CompressedImage, "field")
        self.waypoints = client.watch(PoseArray, "waypoints")
        self.waypoints_base = client.watch(PoseArray, "waypoints_base")
        self.waypoints_oct = client.watch(PoseArray, "waypoints_oct")
        self.tool_path = client.watch(PointCloud2, "tool_path")
        self.plan_status = client.watch(DiagnosticArray, "plan_status")
        self.execution = client.watch(DiagnosticArray, "execution_status")
        small = {"fit__field__grid__log2_table_size": 15, "fit__batch": 4096, "fit__time_budget_s": 0.0}
        spin(Trainer, bscan_count=SHAPE[0], spacing_um=SPACING_UM, device="cpu", fit__steps=150, **small)
        spin(Planner, device="cpu")
        spin(Query, device="cpu")
        spin(
            Simulator, phantom__shape=list(SHAPE), phantom__surface="tilted", time_factor=50.0, bscan_period_s=0.001,
            **simulator,
        )  # fmt: skip
        self.execution.wait(SERVICE_TIMEOUT_S)
        self.fit_progress.wait_matched(SERVICE_TIMEOUT_S)
        client.call(SetBool, "enable_laser", SetBool.Request(data=True), SERVICE_TIMEOUT_S)

    def trigger(self, name: str) -> Any:
        return self.client.call(Trigger, name, Trigger.Request(), SERVICE_TIMEOUT_S)

    def scan(self) -> Any:
        """Scan, wait until the planner has the fitted field, and return that."""
        before = len(self.field.messages)
        answer = self.trigger("scan")
        assert answer.success, answer.message
        # First the field through the measured voxels, then the fitted one, both of the scan's stamp.
        self.field.wait(FIT_TIMEOUT_S, lambda message: len(self.field.messages) > before + 1)
        field = self.field.messages[-1]
        fitted = {"field_hash": field_hash(conversions.field_data(field)), "field_kind": "neural"}
        self.plan_status.wait(SERVICE_TIMEOUT_S, lambda message: fitted.items() <= values(message).items())
        return field

    def set(self, node: str, name: str, value: Any) -> Any:
        """Set one parameter of a node and return the result."""
        asked = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.client.call(SetParameters, f"{node}/set_parameters", asked, SERVICE_TIMEOUT_S).results[0]

    def plan(self, **changes: Any) -> Any:
        """Call plan_raster with corners well inside the field, or changed ones."""
        return self.client.call(GetPlan, "plan_raster", request(**changes), SERVICE_TIMEOUT_S)

    def until_answered(self, service: str, asked: Any) -> Any:
        """Ask for a path until there is one: nothing tells when the query node has taken the field in."""
        for _ in range(ATTEMPTS):
            path = self.client.call(GetPlan, service, asked, SERVICE_TIMEOUT_S).plan
            if path.poses:
                break
        return path

    def staged(self) -> None:
        self.execution.wait(SERVICE_TIMEOUT_S, lambda message: values(message)["state"] == "staged")


def request(
    start: tuple[float, float] = (2e-4, 1.5e-4),
    goal: tuple[float, float] = (6e-4, 5e-4),
    frame: str = "oct_optical_frame",
    tolerance: float = 5e-5,
) -> Any:

    message = GetPlan.Request()
    for pose, (x, y) in ((message.start, start), (message.goal, goal)):
        pose.header.frame_id = frame
        pose.pose.position.x, pose.pose.position.y = x, y
        pose.pose.orientation.w = 1.0
    message.tolerance = tolerance
    return message


def values(message: Any) -> dict[str, str]:
    return status.read(message)[2]


def matrices(path: Any) -> np.ndarray:
    return conversions.poses_to_matrices([stamped.pose for stamped in path.poses])


def has_poses(message: Any) -> bool:
    """The first message of a planner has none: it withdraws what a planner before it may have planned."""
    return bool(message.poses)


def text(message: Any) -> str:
    return str(message.status[0].message)


@pytest.fixture
def graph(spin: Callable[..., Any], client: Any) -> Graph:
    return Graph(spin, client)


def test_from_scan_to_executed_shots(graph: Graph) -> None:
    field = graph.scan()
    path = graph.plan().plan
    assert len(path.poses) > 50
    assert path.header.frame_id == "tool0"
    assert path.header.stamp == field.header.stamp
    for watch, frame in (
        (graph.waypoints, "tool0"), (graph.waypoints_oct, "oct_optical_frame"), (graph.waypoints_base, "base_link"),
    ):  # fmt: skip
        message = watch.wait(SERVICE_TIMEOUT_S, has_poses)
        assert message.header.frame_id == frame
        assert message.header.stamp == field.header.stamp
        assert len(message.poses) == len(path.poses)
    rows = conversions.cloud_to_tool_path(graph.tool_path.wait(SERVICE_TIMEOUT_S, lambda message: message.width > 0))
    assert len(rows) == len(path.poses)
    assert rows["laser_on"].all()
    planned = graph.plan_status.wait(SERVICE_TIMEOUT_S, lambda message: values(message)["state"] == "planned")
    figures = values(planned)
    assert figures["field_kind"] == "neural"
    assert int(figures["waypoints"]) == len(path.poses)
    assert float(figures["hit_rate"]) > 0.5

    graph.staged()
    answer = graph.trigger("execute")
    assert answer.success, answer.message
    done = graph.execution.wait(EXECUTION_TIMEOUT_S, lambda message: values(message)["state"] == "done")
    assert int(values(done)["shots"]) == len(path.poses)

    again = graph.trigger("execute")
    assert not again.success
    assert "executed" in again.message


def test_the_waypoints_lie_on_the_known_surface_in_every_frame(graph: Graph) -> None:
    graph.scan()
    graph.plan()
    poses = conversions.poses_to_matrices(graph.waypoints_oct.wait(SERVICE_TIMEOUT_S, has_poses).poses)
    in_ee = conversions.poses_to_matrices(graph.waypoints.wait(SERVICE_TIMEOUT_S, has_poses).poses)
    in_base = conversions.poses_to_matrices(graph.waypoints_base.wait(SERVICE_TIMEOUT_S, has_poses).poses)
    truth = make_phantom(PhantomConfig(shape=SHAPE, surface="tilted"))
    depth = truth.surface_depth_m(poses[:, 0, 3], poses[:, 1, 3])
    assert np.sqrt(np.mean((poses[:, 2, 3] - depth) ** 2)) < 60e-6
    oct2ee = load_calibration(config_path("calibration.yaml")).oct2ee
    np.testing.assert_allclose(in_ee, oct2ee @ poses, atol=1e-9)
    scan_pose = graph.client.watch(PoseStamped, "scan_ee_pose").wait(SERVICE_TIMEOUT_S)
    np.testing.assert_allclose(in_base, conversions.pose_to_matrix(scan_pose.pose) @ in_ee, atol=1e-9)


def test_query_surface_follows_the_line(graph: Graph) -> None:
    graph.scan()
    line = request(start=(2e-4, 3e-4), goal=(7e-4, 3e-4), tolerance=1e-4)
    path = graph.until_answered("query_surface", line)
    assert len(path.poses) == 6
    assert path.header.frame_id == "oct_optical_frame"
    assert [round(pose.pose.position.x * 1e6) for pose in path.poses] == [200, 300, 400, 500, 600, 700]
    outside = request(start=(2e-4, 3e-4), goal=(7e-1, 3e-4), tolerance=1e-4)
    assert not graph.client.call(GetPlan, "query_surface", outside, SERVICE_TIMEOUT_S).plan.poses


def test_a_new_scan_withdraws_the_plan(graph: Graph) -> None:
    graph.scan()
    assert graph.plan().plan.poses
    graph.staged()
    second = graph.scan()
    refused = graph.trigger("execute")
    assert not refused.success
    assert "new scan" in refused.message or "withdrawn" in refused.message
    empty = graph.waypoints.wait(SERVICE_TIMEOUT_S, lambda message: not message.poses, after=2)
    assert empty.header.stamp == second.header.stamp
    graph.tool_path.wait(SERVICE_TIMEOUT_S, lambda message: message.width == 0, after=2)
    assert graph.plan().plan.poses


def test_bad_requests_are_refused_in_words_and_publish_nothing(graph: Graph) -> None:
    assert not graph.plan().plan.poses
    graph.plan_status.wait(SERVICE_TIMEOUT_S, lambda message: "got none yet" in text(message))
    refused = graph.trigger("execute")
    assert not refused.success
    assert "staged plan" in refused.message
    assert not graph.trigger("refit").success
    assert not graph.trigger("cancel").success

    graph.scan()
    assert graph.set("planner", "raster.point_spacing_m", 1e-6).successful
    for changes, reason in (
        ({"goal": (5e-3, 5e-4)}, "every raster corner inside the scan"),
        ({"goal": (2e-4, 1.5e-4)}, "two sides"),
        ({"frame": "camera_link"}, "camera_link"),
        ({"frame": ""}, "oct_optical_frame, tool0"),
        ({"tolerance": float("nan")}, "line_spacing_m: expected a finite number"),
        ({"tolerance": -1e-4}, "line_spacing_m: expected at least"),
        ({"tolerance": 1e-9}, "line_spacing_m: expected at least"),
        ({"tolerance": 1e-7}, "1,000,000 waypoints"),
        ({"start": (float("nan"), 1e-4)}, "finite"),
    ):
        assert not graph.plan(**changes).plan.poses, changes
        message = graph.plan_status.wait(SERVICE_TIMEOUT_S, lambda message, reason=reason: reason in text(message))
        assert message.status[0].level == ERROR
    assert not any(has_poses(message) for message in graph.waypoints.messages)
    assert graph.set("planner", "raster.point_spacing_m", 5e-5).successful
    assert graph.plan().plan.poses, "the node lives on"
    assert graph.waypoints.wait(SERVICE_TIMEOUT_S, has_poses)


def test_a_plan_may_be_asked_for_in_the_end_effector_and_the_base_frame(graph: Graph) -> None:
    graph.scan()
    expected = matrices(graph.plan().plan)
    oct2ee = load_calibration(config_path("calibration.yaml")).oct2ee
    scan_pose = graph.client.watch(PoseStamped, "scan_ee_pose").wait(SERVICE_TIMEOUT_S)
    ee2base = conversions.pose_to_matrix(scan_pose.pose)
    for frame, oct2frame in (("tool0", oct2ee), ("base_link", ee2base @ oct2ee)):
        asked = request()
        for pose in (asked.start, asked.goal):
            moved = oct2frame @ conversions.pose_to_matrix(pose.pose)
            pose.pose = conversions.matrix_to_pose_stamped(moved, 0, frame).pose
            pose.header.frame_id = frame
        path = graph.client.call(GetPlan, "plan_raster", asked, SERVICE_TIMEOUT_S).plan
        np.testing.assert_allclose(matrices(path), expected, atol=1e-7)


def test_an_old_plan_is_not_executed(spin: Callable[..., Any], client: Any) -> None:
    graph = Graph(spin, client, interlock__plan_max_age_s=0.0)
    graph.scan()
    assert graph.plan().plan.poses
    graph.staged()
    refused = graph.trigger("execute")
    assert not refused.success
    assert "scan and plan again" in refused.message
    assert graph.trigger("abort").success


def test_services_answer_during_a_fit_and_cancel_ends_it(graph: Graph) -> None:
    assert graph.set("trainer", "fit.steps", 10_000_000).successful
    assert graph.trigger("scan").success
    graph.fit_progress.wait(FIT_TIMEOUT_S, lambda message: "loss" in values(message))
    assert graph.trigger("refit").success
    assert graph.trigger("cancel").success
    graph.fit_progress.wait(FIT_TIMEOUT_S, lambda message: values(message).get("state") == "cancelled")
    assert len(graph.field.messages) == 1, "the field through the measured voxels, and no fitted one"
