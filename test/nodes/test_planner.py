"""Planner and query alone: fields and poses that are not what they should be."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from nav_msgs.srv import GetPlan
from sensor_msgs.msg import CompressedImage, PointCloud2
from std_srvs.srv import Trigger

from octn_ros.errors import CalibrationError, PlanError
from octn_ros.field import (
    HashGridConfig,
    InterpolatedField,
    NetworkConfig,
    NeuralFieldConfig,
    dumps_field,
    field_hash,
    loads_field,
)
from octn_ros.nodes import conversions, field_receiver, qos, status
from octn_ros.nodes.planner import Planner
from octn_ros.nodes.query import Query
from octn_ros.planning import from_translation_quaternion
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.training import FitConfig, fit

TIMEOUT_S = 120.0
STAMP_NS = 3_000_000_000
OCT = "oct_optical_frame"


@pytest.fixture(scope="module")
def field_data() -> bytes:
    """A field that has hardly been fitted: enough to be received, not to plan on."""
    small = NeuralFieldConfig(HashGridConfig(levels=2, log2_table_size=8), NetworkConfig(hidden_layers=1, neurons=8))
    phantom = make_phantom(PhantomConfig(shape=(4, 24, 16), surface="flat"))
    volume = dataclasses.replace(phantom.volume, stamp_ns=STAMP_NS)
    return dumps_field(fit(volume, FitConfig(field=small, steps=2, batch=64)).field, half=True)


class Bench:
    """Planner and query, and a client that plays the trainer."""

    def __init__(self, spin: Callable[..., Any], client: Any, **parameters: Any) -> None:
        self.client = client
        self.status = client.watch(DiagnosticArray, "plan_status")
        self.waypoints = client.watch(PoseArray, "waypoints")
        self.field = client.node.create_publisher(CompressedImage, "field", qos.LATCHED)
        self.scan_ee_pose = client.node.create_publisher(PoseStamped, "scan_ee_pose", qos.LATCHED)
        self.planner = spin(Planner, device="cpu", **parameters)
        spin(Query, device="cpu")

    def ask(self, service: str, frame: str = OCT, tolerance: float = 0.0) -> Any:
        request = GetPlan.Request(tolerance=tolerance)
        request.start.header.frame_id = request.goal.header.frame_id = frame
        request.start.pose.position.x, request.start.pose.position.y = 2e-5, 2e-5
        request.goal.pose.position.x, request.goal.pose.position.y = 1e-4, 6e-5
        return self.client.call(GetPlan, service, request, TIMEOUT_S).plan

    def until(self, *words: str) -> dict[str, str]:
        message = self.status.wait(TIMEOUT_S, lambda message: all(word in status.read(message)[1] for word in words))
        return status.read(message)[2]


def test_a_message_that_is_no_field_is_refused_and_the_last_field_kept(
    spin: Callable[..., Any], client: Any, field_data: bytes
) -> None:
    bench = Bench(spin, client)
    bench.field.publish(CompressedImage(format="jpeg"))
    bench.until("field refused", "jpeg")
    bench.field.publish(conversions.to_field_message(field_data[:-10], STAMP_NS, OCT))
    assert bench.until("field refused, there is none", "truncated")["state"] == "refused"
    assert not bench.ask("plan_raster").poses
    assert not bench.ask("query_surface").poses
    bench.until("plan_raster refused", "none yet")
    bench.field.publish(conversions.to_field_message(field_data, STAMP_NS, OCT))
    ready = bench.until("ready to plan")
    identity = {"stamp_ns": str(STAMP_NS), "field_hash": field_hash(field_data), "field_kind": "neural"}
    assert {"state": "ready", **identity}.items() <= ready.items()
    assert float(ready["field_age_s"]) > 0
    bench.field.publish(CompressedImage(format="png"))
    bench.until("field refused, the last one is kept", "png")
    assert not bench.ask("plan_raster", frame="map").poses
    bench.until("plan_raster refused", "'map'")
    assert not any(message.poses for message in bench.waypoints.messages)


def test_a_device_without_memory_refuses_the_field_and_the_nodes_live_on(
    spin: Callable[..., Any], client: Any, field_data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_memory(*arguments: Any) -> None:
        raise RuntimeError("CUDA out of memory")

    bench = Bench(spin, client)
    message = conversions.to_field_message(field_data, STAMP_NS, OCT)
    with monkeypatch.context() as patched:
        patched.setattr(field_receiver, "loads_field", out_of_memory)
        bench.field.publish(message)
        assert bench.until("field refused", "RuntimeError: CUDA out of memory")["state"] == "refused"
    bench.field.publish(message)
    bench.until("ready to plan")


def test_the_base_frame_is_known_only_with_the_pose_of_the_same_scan(
    spin: Callable[..., Any], client: Any, field_data: bytes
) -> None:
    bench = Bench(spin, client)
    pose = from_translation_quaternion((0.4, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0))
    for stamp_ns, frame in ((STAMP_NS - 1, "base_link"), (STAMP_NS, "map")):
        bench.scan_ee_pose.publish(conversions.matrix_to_pose_stamped(pose, stamp_ns, frame))
    bench.field.publish(conversions.to_field_message(field_data, STAMP_NS, OCT))
    bench.until("ready to plan")
    assert not bench.ask("plan_raster", frame="base_link").poses
    bench.until("base_link", "scan_ee_pose", "not known")


@pytest.fixture(scope="module")
def flat_field() -> bytes:
    """A field with a clear, flat surface under all of a small scan."""
    config = PhantomConfig(shape=(24, 96, 24), surface="flat", spacing_m=(4e-5, 1e-5, 4e-5), asymmetric=False)
    return dumps_field(InterpolatedField(dataclasses.replace(make_phantom(config).truth, stamp_ns=STAMP_NS)))


LEADING = {
    "region.size_m": [4e-4, 3e-4],
    "raster.line_spacing_m": 1e-4,
    "raster.lead_in_m": 5e-5,
    "raster.lead_out_m": 5e-5,
}


def test_replan_takes_everything_from_the_parameters(spin: Callable[..., Any], client: Any, flat_field: bytes) -> None:
    bench = Bench(spin, client, **LEADING)
    tool_path = client.watch(PointCloud2, "tool_path")
    answer = client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S)
    assert not answer.success
    assert "none yet" in answer.message
    bench.field.publish(conversions.to_field_message(flat_field, STAMP_NS, OCT))
    bench.until("ready to plan")
    answer = client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S)
    assert answer.success, answer.message
    figures = bench.until("hit rate")
    assert figures["state"] == "planned"
    covered, budget = json.loads(figures["coverage"]), json.loads(figures["error_budget"])
    assert covered["line_gap_m"] <= 1e-4 * 1.001
    assert "calibration oct2ee" in budget["not_stated"]
    assert budget["total_um"] > 0
    rows = conversions.cloud_to_tool_path(tool_path.wait(TIMEOUT_S, lambda message: message.width > 0))
    lines = int(rows["segment"].max()) + 1
    assert lines == 4
    assert (rows["laser_on"] == 0).sum() == 2 * lines
    assert np.isnan(rows["residual"][rows["laser_on"] == 0]).all()


def test_each_report_names_the_plan_that_stands(spin: Callable[..., Any], client: Any, flat_field: bytes) -> None:
    bench = Bench(spin, client, **LEADING)
    tool_path = client.watch(PointCloud2, "tool_path")
    health = client.watch(DiagnosticArray, "/diagnostics", qos.STREAM)
    health.wait_matched(TIMEOUT_S)
    bench.field.publish(conversions.to_field_message(flat_field, STAMP_NS, OCT))
    assert bench.until("ready to plan")["plan_hash"] == ""
    assert client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S).success
    named = conversions.plan_hash(tool_path.wait(TIMEOUT_S, lambda message: message.width > 0))
    expected = {"plan_hash": named, "node": "/octn/planner", "stamp_ns": str(STAMP_NS)}.items()
    assert expected <= bench.until("hit rate").items()
    planned = bench.status.wait(TIMEOUT_S, lambda message: "hit rate" in status.read(message)[1])
    alive = health.wait(TIMEOUT_S, lambda message: status.read(message)[2].get("plan_hash") == named)
    assert alive.status[0].name == "/octn/planner: state"
    apart_ns = conversions.stamp_to_ns(alive.header.stamp) - conversions.stamp_to_ns(planned.header.stamp)
    assert 0 <= apart_ns < 100_000_000, "at once, not only within the second from one report to the next"
    assert not bench.ask("plan_raster", frame="map").poses
    assert expected <= bench.until("plan_raster refused").items()
    bench.field.publish(conversions.to_field_message(flat_field[:-10], STAMP_NS, OCT))
    assert expected <= bench.until("field refused").items()
    bench.field.publish(conversions.to_field_message(flat_field[:-10], STAMP_NS + 1, OCT))
    assert bench.until("field refused", "withdrawn")["plan_hash"] == ""


def test_the_first_field_withdraws_whatever_a_planner_before_this_one_may_have_planned(
    spin: Callable[..., Any], client: Any, flat_field: bytes
) -> None:
    bench = Bench(spin, client, **LEADING)
    in_base, tool_path = client.watch(PoseArray, "waypoints_base"), client.watch(PointCloud2, "tool_path")
    bench.field.publish(conversions.to_field_message(flat_field, STAMP_NS, OCT))
    bench.until("ready to plan")
    for watch in (bench.waypoints, in_base):
        told = watch.wait(TIMEOUT_S)
        assert (list(told.poses), conversions.stamp_to_ns(told.header.stamp)) == ([], STAMP_NS)
    told = tool_path.wait(TIMEOUT_S)
    assert (told.width, conversions.stamp_to_ns(told.header.stamp)) == (0, STAMP_NS)
    assert client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S).success
    assert bench.waypoints.wait(TIMEOUT_S, after=1).poses


def test_a_refused_field_of_a_newer_scan_withdraws_the_plan_and_one_of_the_same_scan_does_not(
    spin: Callable[..., Any], client: Any, flat_field: bytes
) -> None:
    bench = Bench(spin, client, **LEADING)
    bench.field.publish(conversions.to_field_message(flat_field, STAMP_NS, OCT))
    bench.until("ready to plan")
    assert client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S).success
    bench.waypoints.wait(TIMEOUT_S, lambda message: len(message.poses) > 0)
    planned = len(bench.waypoints.messages)
    bench.field.publish(conversions.to_field_message(flat_field[:-10], STAMP_NS, OCT))
    bench.until("field refused, the last one is kept", "truncated")
    assert bench.waypoints.messages[-1].poses
    bench.field.publish(conversions.to_field_message(flat_field, STAMP_NS + 1, OCT))
    assert bench.until("field refused", "is withdrawn, for there is a newer scan")["state"] == "refused"
    bench.waypoints.wait(TIMEOUT_S, lambda message: not message.poses, after=planned)


def test_a_field_of_an_older_scan_than_the_last_is_taken_with_a_warning(
    spin: Callable[..., Any], client: Any, flat_field: bytes, field_data: bytes
) -> None:
    bench, queried = Bench(spin, client, **LEADING), client.watch(DiagnosticArray, "query_status")
    newer = dataclasses.replace(loads_field(flat_field).volume, stamp_ns=STAMP_NS + 50 * 10**9)
    bench.field.publish(conversions.to_field_message(dumps_field(InterpolatedField(newer)), newer.stamp_ns, OCT))
    bench.until("ready to plan")
    queried.wait(TIMEOUT_S, lambda message: "received" in status.read(message)[1])
    assert client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S).success
    older = "whose scan is 50.0 s older than that of the last field"
    bench.field.publish(conversions.to_field_message(field_data, STAMP_NS, OCT))
    for watch, words in ((bench.status, f"{older}; the plan of the last one is withdrawn"), (queried, f", {older}")):
        told = watch.wait(TIMEOUT_S, lambda message, words=words: words in status.read(message)[1])
        level, _, values = status.read(told)
        assert (level, values["state"], values["stamp_ns"]) == (status.WARN, "ready", str(STAMP_NS))


def test_another_pose_of_the_same_scan_withdraws_the_plan_that_was_placed_by_the_last(
    spin: Callable[..., Any], client: Any, flat_field: bytes
) -> None:
    bench = Bench(spin, client, **LEADING)
    in_base = client.watch(PoseArray, "waypoints_base")
    told = [from_translation_quaternion((x_m, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0)) for x_m in (0.4, 0.401)]

    def tell(pose: np.ndarray) -> None:
        bench.scan_ee_pose.publish(conversions.matrix_to_pose_stamped(pose, STAMP_NS, "base_link"))

    def plan() -> Any:
        seen = len(in_base.messages)
        assert client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S).success
        return in_base.wait(TIMEOUT_S, lambda message: len(message.poses) > 0, after=seen)

    client.wait_for(lambda: bench.scan_ee_pose.get_subscription_count() == 2, TIMEOUT_S, "planner and query")
    tell(told[0])
    bench.field.publish(conversions.to_field_message(flat_field, STAMP_NS, OCT))
    bench.until("ready to plan")
    client.wait_for(lambda: bench.planner._scan_poses.ee2base(STAMP_NS) is not None, TIMEOUT_S, "the pose")
    first = plan()
    tell(told[0])  # said again it changes nothing
    tell(told[1])
    assert bench.until("a nearer pose of the scan has come", "withdrawn")["state"] == "ready"
    bench.waypoints.wait(TIMEOUT_S, lambda message: not message.poses, after=2)
    in_base.wait(TIMEOUT_S, lambda message: not message.poses, after=2)
    assert [bool(message.poses) for message in bench.waypoints.messages] == [False, True, False]
    second = plan()
    assert second.poses[0].position.x - first.poses[0].position.x == pytest.approx(1e-3)


def test_a_plan_through_a_keep_out_region_is_refused_and_not_published(
    spin: Callable[..., Any], client: Any, flat_field: bytes, tmp_path: Any
) -> None:
    path = tmp_path / "keep_out.yaml"
    middle = 23 * 4e-5 / 2
    box = f"{{min_m: [{middle - 3e-5:.6f}, {middle - 3e-5:.6f}, 0], max_m: [{middle + 3e-5:.6f}, 1, 1]}}"
    path.write_text(f"units: m\nkeep_out:\n  - {{name: vessel, frame: oct, box: {box}}}\n", encoding="utf-8")
    bench = Bench(spin, client, **LEADING, keep_out=str(path))
    bench.field.publish(conversions.to_field_message(flat_field, STAMP_NS, OCT))
    bench.until("ready to plan")
    answer = client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S)
    assert not answer.success
    assert "keep-out region 'vessel'" in answer.message
    assert bench.until("replan refused", "vessel", "waypoint")["state"] == "refused"
    assert not any(message.poses for message in bench.waypoints.messages)
    path.write_text("units: m\nkeep_out: 3\n", encoding="utf-8")
    with pytest.raises(PlanError, match="list keep_out"):
        spin(Planner, device="cpu", keep_out=str(path))


def test_a_query_for_too_many_samples_is_refused(spin: Callable[..., Any], client: Any, field_data: bytes) -> None:
    bench = Bench(spin, client)
    bench.field.publish(conversions.to_field_message(field_data, STAMP_NS, OCT))
    bench.until("ready to plan")
    for tolerance in (1e-12, -1.0, float("nan")):
        assert not bench.ask("query_surface", tolerance=tolerance).poses


def test_a_calibration_that_is_not_rigid_ends_the_start(spin: Callable[..., Any], tmp_path: Any) -> None:
    path = tmp_path / "calibration.yaml"
    mirrored = "[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    path.write_text(f"units: m\noct2ee: {mirrored}\nlaser2ee: {mirrored}\n", encoding="utf-8")
    for kind in (Planner, Query):
        with pytest.raises(CalibrationError, match="orthonormal"):
            spin(kind, calibration=str(path))
